"""The codec against frames made by hand, and against anything at all."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.links import wire
from vcl_companion.clock import system_moment
from vcl_companion.geometry.rotation import matrix_from_euler, matrix_from_quaternion
from vcl_companion.links.counters import LinkTally
from vcl_companion.links.decoding import Decoder
from vcl_companion.links.mavlink import Codec
from vcl_companion.links.messages import (
    AttitudeSample,
    CommandAck,
    CommandLong,
    EstimatorStatus,
    Heartbeat,
    Message,
    StatusText,
    Timesync,
    Tunnel,
)


def codec(system_id: int = 1) -> tuple[Codec, LinkTally]:
    tally = LinkTally()
    return Codec(system_id, 197, tally), tally


def decoded(data: bytes) -> Message:
    (message,) = codec()[0].decode_datagram(data)
    return message


def refusals(data: bytes) -> dict[str, int]:
    ours, tally = codec()
    ours.decode_datagram(data)
    return dict(tally.snapshot().refused)


def test_frames_made_by_hand_are_understood() -> None:
    assert decoded(wire.heartbeat()) == Heartbeat(1, 1, 2, 3, 1, 4, 4)
    assert decoded(wire.packed(wire.TIMESYNC, -5, 2**62)) == Timesync(1, 1, -5, 2**62)
    text = wire.packed(wire.STATUSTEXT, 6, b"PreArm: ok", 0, 0)
    assert decoded(text) == StatusText(1, 1, 6, "PreArm: ok", 0, 0)
    command = wire.packed(wire.COMMAND_LONG, 1, 2, 3, 4, 5, 6, 7, 31010, 9, 197, 2, system=255)
    expected = CommandLong(255, 1, 9, 197, 31010, 2, (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0))
    assert decoded(command) == expected
    ack = wire.packed(wire.COMMAND_ACK, 511, 4, 0, 0, 9, 197)
    assert decoded(ack) == CommandAck(1, 1, 511, 4, 9, 197, 0)


def estimator_status(flags: int, ratio: float) -> bytes:
    """As PX4 1.16.1 sends it; ratios that it does not test are no numbers."""
    nan = math.nan
    return wire.packed(
        wire.ESTIMATOR_STATUS, 60_000_000, nan, ratio, 0.01, nan, nan, nan, 0.1, 0.1, flags
    )


@pytest.mark.parametrize(
    ("flags", "ratio", "expected"),
    [
        (0xA5, math.nan, EstimatorStatus(1, 1, False, True, None)),  # on the ground, without us
        (0x25, math.nan, EstimatorStatus(1, 1, False, False, None)),  # moved, without us
        (0x1AF, 0.25, EstimatorStatus(1, 1, True, False, 0.25)),  # on the ground, with us
        (0x12F, 0.25, EstimatorStatus(1, 1, True, False, 0.25)),  # in flight, with us
    ],
)
def test_px4_s_estimator_is_read_as_it_means_it(
    flags: int, ratio: float, expected: EstimatorStatus
) -> None:
    assert decoded(estimator_status(flags, ratio)) == expected


def test_ardupilot_s_estimator_is_read_or_refused() -> None:
    held = wire.packed(wire.EKF_STATUS_REPORT, 0.0, 0.5, 0.0, 0.0, 0.0, 0xA7)
    assert decoded(held) == EstimatorStatus(1, 1, False, True, 0.5)
    used = wire.packed(wire.EKF_STATUS_REPORT, 0.0, 0.5, 0.0, 0.0, 0.0, 0x33F)
    assert decoded(used) == EstimatorStatus(1, 1, True, False, 0.5)
    broken = wire.packed(wire.EKF_STATUS_REPORT, 0.0, math.nan, 0.0, 0.0, 0.0, 0x33F)
    assert refusals(broken) == {"estimator's test ratio is no number": 1}


def test_attitudes_become_rotations() -> None:
    sample = decoded(wire.attitude_quaternion(1234, (0.5, -0.5, 0.5, 0.5)))
    assert isinstance(sample, AttitudeSample)
    assert (sample.time_boot_ms, sample.source) == (1234, "quaternion")
    expected = matrix_from_quaternion(np.array([0.5, -0.5, 0.5, 0.5]))
    np.testing.assert_allclose(sample.ned_from_body, expected, atol=1e-12)
    assert not sample.ned_from_body.flags.writeable
    sample = decoded(wire.packed(wire.ATTITUDE, 7, 0.25, -0.5, 1.5, 0, 0, 0))
    assert isinstance(sample, AttitudeSample)
    assert (sample.time_boot_ms, sample.source) == (7, "euler")
    np.testing.assert_allclose(sample.ned_from_body, matrix_from_euler(0.25, -0.5, 1.5), atol=1e-12)


def test_body_rates_are_taken_and_become_the_rate_of_the_heading() -> None:
    on_its_side = decoded(wire.packed(wire.ATTITUDE, 7, math.pi / 2, 0, 0.3, 0, 2.0, 0.5))
    assert isinstance(on_its_side, AttitudeSample)
    assert on_its_side.heading_rate_rad_s == pytest.approx(2.0)  # its right wing points down
    assert on_its_side.body_rates_rad_s == pytest.approx(np.array([0.0, 2.0, 0.5]))
    upright = decoded(
        wire.packed(wire.ATTITUDE_QUATERNION, 7, 1, 0, 0, 0, 3.0, 2.0, -0.5, 0, 0, 0, 0)
    )
    assert isinstance(upright, AttitudeSample)
    assert upright.heading_rate_rad_s == pytest.approx(-0.5)
    # All zero: a simulator without gyros.
    for rate in (math.nan, math.inf, 0.0):
        unknown = decoded(wire.packed(wire.ATTITUDE, 7, 0.25, -0.5, 1.5, rate, 0, 0))
        assert isinstance(unknown, AttitudeSample)
        assert unknown.heading_rate_rad_s is None
        assert unknown.body_rates_rad_s is None


@pytest.mark.parametrize(
    "quaternion", [(math.nan, 0, 0, 0), (math.inf, 0, 0, 0), (0, 0, 0, 0), (2, 0, 0, 0)]
)
def test_what_is_no_rotation_is_refused(quaternion: tuple[float, float, float, float]) -> None:
    assert refusals(wire.attitude_quaternion(1, quaternion)) == {"attitude is no rotation": 1}


def test_not_a_number_of_an_angle_is_refused() -> None:
    data = wire.packed(wire.ATTITUDE, 7, math.nan, 0, 0, 0, 0, 0)
    assert refusals(data) == {"attitude is no rotation": 1}


def test_a_tunnel_length_that_lies_is_refused() -> None:
    assert refusals(wire.tunnel(b"x", system=2, length=129)) == {"tunnel length is a lie": 1}
    assert refusals(wire.tunnel(b"x", system=2, length=255)) == {"tunnel length is a lie": 1}
    whole = decoded(wire.tunnel(bytes(range(128)), system=2))
    assert whole == Tunnel(2, 197, 0, 40000, bytes(range(128)))


def test_a_tunnel_for_another_component_is_refused() -> None:
    data = wire.tunnel(b"x", system=2, target=1, target_component=1)
    assert refusals(data) == {"tunnel for another component": 1}


def test_of_a_datagram_of_nothing_but_magic_numbers_few_checksums_are_reckoned() -> None:
    refused = refusals(b"\xfe" * 65_000)
    assert 0 < refused["wrong checksum"] < 100
    assert refused["garbage bytes"] > 60_000
    refused = refusals(b"\xfd\xff" * 32_000)
    assert 0 < refused["unknown incompatibility flags"] < 100
    # What damage makes of some frames does not hide the next.
    ours, _ = codec()
    damaged = b"".join(wire.tunnel(bytes([k]) * 120, system=2)[:-1] + b"x" for k in range(5))
    assert ours.decode_datagram(damaged + wire.heartbeat()) == [decoded(wire.heartbeat())]


def test_refusals_name_their_reason() -> None:
    good = wire.heartbeat()
    assert refusals(good[:-1] + bytes([good[-1] ^ 1])) == {"wrong checksum": 1, "garbage bytes": 20}
    assert refusals(good[:-1]) == {"truncated": 1}
    assert refusals(b"hello") == {"garbage bytes": 5}
    assert refusals(wire.frame_1(0, bytes(9))) == {"MAVLink 1": 1}
    assert refusals(wire.frame(0xABCDE, b"abc", crc_extra=7)) == {"unknown message": 1}
    strange = wire.frame(0, wire.LAYOUT[0].pack(4, 2, 3, 1, 4, 3), flags=2)
    assert refusals(strange)["unknown incompatibility flags"] == 1


def test_a_signed_frame_and_unknown_extensions_are_read() -> None:
    payload = wire.LAYOUT[wire.TIMESYNC].pack(0, 77)
    assert decoded(wire.frame(wire.TIMESYNC, payload, flags=1)) == Timesync(1, 1, 0, 77)
    # Newer dialects append a target to TIMESYNC; still newer ones may append more.
    for more in (b"", b"\x01\x02"):
        addressed = decoded(wire.frame(wire.TIMESYNC, payload + b"\x09\xc5" + more))
        assert addressed == Timesync(1, 1, 0, 77, 9, 197)


def test_a_time_for_one_companion_is_told_as_newer_dialects_do() -> None:
    ours, _ = codec()
    payload = wire.LAYOUT[wire.TIMESYNC].pack(2**62, -77) + b"\x09\xc5"
    frame = wire.frame(wire.TIMESYNC, payload, component=197, sequence=0)
    assert ours.timesync(2**62, -77, target_system=9) == frame
    assert len(frame) == 30
    assert decoded(ours.timesync(2**62, -77)) == Timesync(1, 197, 2**62, -77)


def test_a_message_hidden_in_an_unknown_one_is_not_read() -> None:
    hidden = wire.tunnel(b"evil", system=2)
    data = wire.frame(0xABCDE, hidden, crc_extra=7) + wire.heartbeat()
    ours, tally = codec()
    assert ours.decode_datagram(data) == [decoded(wire.heartbeat())]
    assert tally.snapshot().refused == {"unknown message": 1}


def test_a_false_start_does_not_swallow_what_follows() -> None:
    ours, tally = codec()
    data = b"\xfd\x20" + wire.heartbeat() + wire.tunnel(b"payload" * 10, system=2)
    assert len(ours.decode_stream(data)) == 2
    assert tally.snapshot().messages_in == 2


@given(st.lists(st.integers(1, 40), min_size=1), st.binary(max_size=20))
def test_a_stream_is_the_same_however_it_is_cut(cuts: list[int], garbage: bytes) -> None:
    garbage = garbage.replace(b"\xfd", b"").replace(b"\xfe", b"")
    frames = [wire.heartbeat(), garbage, wire.tunnel(b"abc", system=2), wire.packed(111, 0, 5)]
    stream = b"".join(frames)
    whole, _ = codec()
    cut, tally = codec()
    messages, at = [], 0
    for step in cuts:
        messages += cut.decode_stream(stream[at : at + step])
        at += step
    messages += cut.decode_stream(stream[at:])
    assert messages == whole.decode_stream(stream)
    assert len(messages) == 3
    assert tally.snapshot().refused.get("garbage bytes", 0) == len(garbage)


@given(st.binary(max_size=600))
def test_any_bytes_are_survived(data: bytes) -> None:
    tally = LinkTally()
    ours = Decoder((1, 197), tally, None, system_moment)
    ours.datagram(data)
    ours.stream(data)
    assert len(ours.unfinished) <= 280
    # Whatever stood before it, a frame and enough bytes after it bring the stream back.
    messages = ours.stream(wire.heartbeat() * 40)
    assert messages
    assert tally.snapshot().bytes_in == 0


@given(st.sampled_from(sorted(wire.CRC_EXTRA)), st.binary(min_size=1, max_size=255))
def test_any_payload_with_a_right_checksum_is_survived(message_id: int, payload: bytes) -> None:
    ours, tally = codec()
    ours.decode_datagram(wire.frame(message_id, payload))
    assert tally.snapshot().messages_in == 1


@given(st.integers(0, 255), st.integers(32768, 65535), st.binary(max_size=128), st.integers(1, 255))
def test_tunnels_come_back_as_they_went(
    target: int, payload_type: int, payload: bytes, system: int
) -> None:
    ours, _ = codec(system)
    data = ours.tunnel(target, payload_type, payload)
    assert decoded(data) == Tunnel(system, 197, target, payload_type, payload)
    assert len(data) <= 145


def test_a_tunnel_that_is_too_long_is_a_bug_of_ours() -> None:
    with pytest.raises(ValueError, match="128"):
        codec()[0].tunnel(0, 40000, bytes(129))


def test_what_we_send_reads_by_the_published_layout() -> None:
    ours, tally = codec(9)
    covariance = np.arange(36.0).reshape(6, 6)
    sent = [
        ours.heartbeat(4),
        ours.timesync(0, 2**60 + 1),
        ours.tunnel(3, 40001, b"\x01\x02\x00"),
        ours.status_text(4, b"lost", 0, 0),
        ours.set_message_interval(9, 31, 20000),
        ours.vision_position_estimate(2**50, (1, 2, -3), (0.5, 0.25, 2), covariance, 255),
    ]
    seen = wire.read(b"".join(sent))
    assert [(s.sequence, s.system, s.component) for s in seen] == [(i, 9, 197) for i in range(6)]
    assert seen[0].fields == (0, 18, 8, 0, 4, 3)
    assert seen[1].fields == (0, 2**60 + 1)
    assert seen[2].fields == (40001, 3, 197, 3, b"\x01\x02".ljust(128, b"\0"))
    assert seen[3].fields == (4, b"lost".ljust(50, b"\0"), 0, 0)
    assert seen[4].fields == (31, 20000, 0, 0, 0, 0, 0, 511, 9, 1, 0)
    upper = [0, 1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 14, 15, 16, 17, 21, 22, 23, 28, 29, 35]
    assert seen[5].fields == (2**50, 1, 2, -3, 0.5, 0.25, 2, *upper, 255)
    assert tally.snapshot().messages_out == 6


def test_sent_bytes_never_change() -> None:
    ours, _ = codec(1)
    assert ours.heartbeat(4).hex() == "fd0900000001c50000000000000012080004031ee4"
    tunnel = ours.tunnel(2, 40000, b"vcl\0x")
    assert tunnel.hex() == "fd0a00000101c5810100409c02c50576636c0078ab07"
    covariance = np.diag([0.01, 0.02, 0.03, 0.001, 0.002, 0.003])
    pose = ours.vision_position_estimate(
        1_403_636_579_763_555, (1.5, -2.5, -30), (0.25, -0.5, 2), covariance, 7
    )
    assert pose.hex() == (
        "fd7500000201c56600006305bb9b99fc04000000c03f000020c00000f0c10000803e000000bf00000040"
        "0ad7233c00000000000000000000000000000000000000000ad7a33c0000000000000000000000000000"
        "00008fc2f53c0000000000000000000000006f12833a00000000000000006f12033b00000000a69b443b"
        "07796b"
    )
