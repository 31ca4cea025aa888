"""Signatures against the guide, against pymavlink, and against whoever has no key."""

import hashlib
import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from tests.links import signed, wire
from tests.links.signed import NOON, SECRET, Clocks
from vcl_companion.links.counters import LinkTally
from vcl_companion.links.mavlink import Codec
from vcl_companion.links.messages import Heartbeat, Timesync, Tunnel, Untimely
from vcl_companion.links.signing import Signing, SigningKey

S = 100_000  # ticks
RADIO_STATUS, SETUP_SIGNING = 109, 256


def codec(signing: Signing, clocks: Clocks, system_id: int = 1) -> tuple[Codec, LinkTally]:
    tally = LinkTally()
    return Codec(system_id, 197, tally, signing, clocks.now), tally


def refused(data: bytes, clocks: Clocks | None = None) -> dict[str, int]:
    """What a fresh codec counts; nothing of it may be heard."""
    clocks = clocks or Clocks()
    ours, tally = codec(signed.signing(clocks), clocks)
    assert all(isinstance(message, Untimely) for message in ours.decode_datagram(data))
    return dict(tally.snapshot().refused)


def test_a_sent_frame_is_signed_as_the_guide_says() -> None:
    clocks = Clocks()
    ours, _ = codec(signed.signing(clocks), clocks)
    data = ours.heartbeat(4)
    body = bytes.fromhex("09010000 01c5 000000 000000001208000403")
    crc = wire.crc(body + bytes([wire.CRC_EXTRA[wire.HEARTBEAT]])).to_bytes(2, "little")
    told = b"\x00" + NOON.to_bytes(6, "little")
    frame = b"\xfd" + body + crc
    assert data == frame + told + hashlib.sha256(SECRET + frame + told).digest()[:6]


def test_signed_bytes_never_change() -> None:
    clocks = Clocks()
    ours, _ = codec(signed.signing(clocks), clocks)
    sent = ours.heartbeat(4).hex(), ours.tunnel(2, 40000, b"vcl\0x").hex()
    assert sent == (
        "fd0901000001c5000000000000001208000403f91c0000988adba1236ee0b6c0f7f6",
        "fd0a01000101c5810100409c02c50576636c0078e2940001988adba123496093576d20",
    )


def test_a_signed_tunnel_takes_158_bytes() -> None:
    clocks = Clocks()
    ours, _ = codec(signed.signing(clocks), clocks)
    assert len(ours.tunnel(2, 40000, b"x" * 128)) == 158


def test_timestamps_rise_by_frame_and_with_the_clock() -> None:
    clocks = Clocks()
    ours, _ = codec(signed.signing(clocks), clocks)
    stamps = []
    for seconds in (0.0, 0.0, 0.0, 1.0, 3600.0, 0.0):
        clocks.pass_s(seconds)
        stamps.append(int.from_bytes(ours.heartbeat(4)[-12:-6], "little") - NOON)
    assert stamps == [0, 1, 2, 1 * S, 3601 * S, 3601 * S + 1]


def test_pymavlink_takes_what_we_sign() -> None:
    clocks = Clocks()
    ours, _ = codec(signed.signing(clocks), clocks)
    theirs = dialect.MAVLink(None)
    theirs.signing.secret_key = SECRET
    theirs.signing.timestamp = NOON
    for data in (ours.heartbeat(4), ours.tunnel(0, 40000, b"abc\0"), ours.timesync(0, 5)):
        theirs.decode(bytearray(data))
    assert theirs.signing.goodsig_count == 3
    theirs.signing.secret_key = bytes(32)
    with pytest.raises(dialect.MAVError):
        theirs.decode(bytearray(ours.heartbeat(4)))


def test_we_take_what_pymavlink_signs() -> None:
    clocks = Clocks()
    ours, tally = codec(signed.signing(clocks), clocks)
    theirs = dialect.MAVLink(None, srcSystem=2, srcComponent=197)
    theirs.signing.secret_key = SECRET
    theirs.signing.sign_outgoing = True
    theirs.signing.link_id = 7
    theirs.signing.timestamp = NOON
    beat = dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
    tunnel = dialect.MAVLink_tunnel_message(0, 0, 40000, 3, b"abc".ljust(128, b"\0"))
    got = [m for sent in (beat, tunnel) for m in ours.decode_datagram(sent.pack(theirs))]
    assert got == [Heartbeat(2, 197, 18, 8, 0, 0, 4), Tunnel(2, 197, 0, 40000, b"abc")]
    assert tally.snapshot().refused == {}
    theirs.signing.secret_key = bytes(32)
    assert ours.decode_datagram(beat.pack(theirs)) == []
    assert tally.snapshot().refused == {"wrong signature": 1}


def test_everything_that_is_not_as_it_should_be_is_refused_by_reason() -> None:
    unsigned = wire.heartbeat(2, 197)
    assert refused(unsigned) == {"not signed": 1}
    assert refused(signed.frame(NOON, secret=bytes(32))) == {"wrong signature": 1}
    assert refused(signed.frame(NOON + 61 * S)) == {"timestamp in the future": 1}
    assert refused(signed.frame(2**48 - 1)) == {"timestamp in the future": 1}
    assert refused(signed.frame(NOON - 61 * S)) == {"timestamp too old": 1}
    assert refused(signed.frame(0)) == {"timestamp too old": 1}
    assert refused(signed.frame(NOON)[:-1]) == {"truncated": 1}
    assert refused(wire.frame_1(0, bytes(9))) == {"MAVLink 1": 1}
    # The flag alone does not make a signature, nor does taking the signature off.
    flagged = wire.frame(wire.HEARTBEAT, wire.LAYOUT[0].pack(0, 18, 8, 0, 4, 3), flags=1)
    assert refused(flagged) == {"wrong signature": 1}


def test_the_skew_is_allowed_in_both_directions() -> None:
    for off in (-60 * S, 60 * S):
        assert signed.judge(Clocks())(signed.frame(NOON + off)) is None


def test_no_frame_counts_twice() -> None:
    judged = signed.judge(Clocks())
    frames = [signed.frame(NOON + k) for k in range(5)]
    assert [judged(data) for data in frames + frames] == [None] * 5 + ["replayed"] * 5
    # Other senders, components and links have timestamps of their own.
    assert judged(signed.frame(NOON, system=3)) is None
    assert judged(signed.frame(NOON, component=1)) is None
    assert judged(signed.frame(NOON, link_id=1)) is None


def test_frames_may_overtake_each_other_by_a_second() -> None:
    judged = signed.judge(Clocks())
    assert judged(signed.frame(NOON)) is None
    assert judged(signed.frame(NOON + 2 * S)) is None
    assert judged(signed.frame(NOON + S)) == "replayed"
    assert judged(signed.frame(NOON + S + 1)) is None
    assert judged(signed.frame(NOON + S + 1)) == "replayed"


@given(st.lists(st.integers(-70 * S, 70 * S), max_size=60), st.integers(0, 3 * S))
def test_in_any_order_none_counts_twice(offsets: list[int], step: int) -> None:
    clocks = Clocks()
    ours = signed.signing(clocks)
    taken = set()
    latest = -(2**48)
    for k, off in enumerate(offsets):
        timestamp = NOON + (off if step == 0 else off // S + k * step)
        if ours.refusal(signed.frame(timestamp), clocks.now()) is None:
            assert timestamp not in taken
            assert timestamp > latest - S
            assert abs(timestamp - NOON) <= 60 * S
            taken.add(timestamp)
            latest = max(latest, timestamp)
        else:
            late = timestamp <= latest - S or timestamp in taken
            assert late or abs(timestamp - NOON) > 60 * S


def test_a_flood_of_one_stream_takes_no_more_memory_and_nothing_twice() -> None:
    judged = signed.judge(Clocks())
    # Each pair in the wrong order, more of them than are remembered.
    stamps = [NOON + k + (1 if k % 2 == 0 else -1) for k in range(12_000)]
    assert {judged(signed.frame(at)) for at in stamps} == {None}
    assert {judged(signed.frame(at)) for at in stamps} == {"replayed"}


def test_a_forged_frame_of_the_far_future_locks_nobody_out() -> None:
    judged = signed.judge(Clocks())
    assert judged(signed.frame(NOON + 50 * S, secret=bytes(32))) == "wrong signature"
    assert judged(signed.frame(2**48 - 1, secret=bytes(32))) == "wrong signature"
    assert judged(signed.frame(2**48 - 1)) == "timestamp in the future"
    assert judged(signed.frame(NOON)) is None


def test_what_was_heard_before_a_restart_is_not_heard_again() -> None:
    clocks = Clocks()
    before = signed.signing(clocks)
    recorded = [signed.frame(NOON + k * S) for k in range(30)]
    assert [before.refusal(data, clocks.now()) for data in recorded] == [None] * 30
    marks = before.marks(clocks.now())
    assert marks == {(2, 197, 0): NOON + 29 * S}
    after = signed.judge(clocks, marks=marks)
    assert [after(data) for data in recorded] == ["replayed"] * 30
    assert after(signed.frame(NOON + 30 * S)) is None


def test_marks_are_forgotten_when_they_would_refuse_nothing_more() -> None:
    clocks = Clocks()
    ours = signed.signing(clocks)
    data = signed.frame(NOON)
    assert ours.refusal(data, clocks.now()) is None
    assert ours.marks(clocks.pass_s(60.0)) == {(2, 197, 0): NOON}
    assert ours.marks(clocks.pass_s(0.001)) == {}
    assert ours.refusal(data, clocks.now()) == "timestamp too old"


def test_streams_are_bounded_and_make_room_as_time_passes() -> None:
    clocks = Clocks()
    ours = signed.signing(clocks)
    for k in range(1024):
        data = signed.frame(NOON, system=1 + k % 4, component=k // 4)
        assert ours.refusal(data, clocks.now()) is None
    newcomer = signed.frame(NOON + 1, system=9)
    assert ours.refusal(newcomer, clocks.now()) == "too many streams"
    known = signed.frame(NOON + 1, system=1, component=0)
    assert ours.refusal(known, clocks.now()) is None
    now = clocks.pass_s(61.0)
    assert ours.refusal(signed.frame(NOON + 61 * S, system=9), now) is None


def test_radios_need_not_sign() -> None:
    status = wire.frame(RADIO_STATUS, bytes(range(1, 10)), system=51, component=68, crc_extra=185)
    assert refused(status) == {}


def test_keys_by_radio_are_never_taken_in() -> None:
    payload = bytes(range(1, 43))
    assert refused(wire.frame(SETUP_SIGNING, payload, crc_extra=71)) == {"a key by radio": 1}
    tally = LinkTally()
    assert (
        Codec(1, 197, tally).decode_datagram(wire.frame(SETUP_SIGNING, payload, crc_extra=71)) == []
    )
    assert tally.snapshot().refused == {"a key by radio": 1}


def test_unsigned_frames_are_taken_where_that_is_allowed() -> None:
    unsigned = wire.heartbeat(2, 197)
    assert signed.judge(Clocks(), allow_unsigned=True)(unsigned) is None
    # With a key, what is signed must be signed right all the same.
    forged = signed.frame(NOON, secret=bytes(32))
    assert signed.judge(Clocks(), allow_unsigned=True)(forged) == "wrong signature"
    without = signed.judge(Clocks(), allow_unsigned=True, secret=None)
    assert (without(unsigned), without(forged)) == (None, None)
    closed = signed.judge(Clocks(), secret=None)
    assert closed(unsigned) == "not signed"
    assert closed(forged) == "no key to verify with"


def test_without_a_key_nothing_is_signed() -> None:
    clocks = Clocks()
    ours, _ = codec(signed.signing(clocks, secret=None), clocks)
    assert wire.read(ours.heartbeat(4))[0].message_id == wire.HEARTBEAT
    with pytest.raises(ValueError, match="no key"):
        signed.signing(clocks, secret=None).trailer(b"", clocks.now())


def test_a_frame_of_another_time_only_tells_the_time() -> None:
    clocks = Clocks()
    ours, _ = codec(signed.signing(clocks), clocks)
    late = ours.decode_datagram(signed.tunnel(b"an old map", NOON - 3600 * S))
    assert late == [Untimely(2, 197, NOON - 3600 * S, False, None)]
    payload = wire.LAYOUT[wire.TIMESYNC].pack(0, 77)
    early = ours.decode_datagram(signed.frame(NOON + 3600 * S, wire.TIMESYNC, payload))
    assert early == [Untimely(2, 197, NOON + 3600 * S, True, Timesync(2, 197, 0, 77))]


def test_a_key_does_not_show_itself() -> None:
    key = SigningKey(SECRET)
    fingerprint = hashlib.sha256(b"vcl key fingerprint\0" + SECRET).hexdigest()[:16]
    assert repr(key) == f"SigningKey({fingerprint})"
    assert SECRET.hex() not in repr(vars(key))
    with pytest.raises(TypeError):
        pickle.dumps(key)
    with pytest.raises(ValueError, match="32 bytes, got 3") as wrong:
        SigningKey(b"abc")
    assert "abc" not in str(wrong.value)


def mutated(data: bytes, at: int, to: int, cut: int, tail: bytes) -> bytes:
    at %= len(data)
    return (data[:at] + bytes([to]) + data[at + 1 :])[: len(data) - cut] + tail


def with_right_checksum(data: bytes) -> bytes:
    """What one makes of a frame who can do sums, but has no key."""
    if len(data) < 27:
        return data
    body = data[1:-15]
    extra = wire.CRC_EXTRA.get(int.from_bytes(data[7:10], "little"), 0)
    return data[:-15] + wire.crc(body + bytes([extra])).to_bytes(2, "little") + data[-13:]


@given(
    st.integers(0, 300),
    st.integers(0, 255),
    st.integers(0, 20),
    st.binary(max_size=40),
    st.booleans(),
)
def test_a_changed_frame_is_never_heard(
    at: int, to: int, cut: int, tail: bytes, sums: bool
) -> None:
    clocks = Clocks()
    ours, _ = codec(signed.signing(clocks), clocks)
    whole = signed.tunnel(b"a map" * 20, NOON)
    data = mutated(whole, at, to, cut, tail)
    if sums:
        data = with_right_checksum(data)
    heard = ours.decode_datagram(data)
    if whole in data:  # with something behind it
        assert heard == [Tunnel(2, 197, 0, 40000, b"a map" * 20)]
    else:
        assert heard == []


@given(st.binary(max_size=400))
def test_any_bytes_are_survived_and_none_is_heard(data: bytes) -> None:
    clocks = Clocks()
    ours, _ = codec(signed.signing(clocks), clocks)
    assert ours.decode_datagram(data) == []
    assert ours.decode_stream(data) == []


@given(st.binary(max_size=255), st.sampled_from(sorted(wire.CRC_EXTRA)))
def test_any_signed_payload_is_survived(payload: bytes, message_id: int) -> None:
    clocks = Clocks()
    ours, tally = codec(signed.signing(clocks), clocks)
    ours.decode_datagram(signed.frame(NOON, message_id, payload or b"\0"))
    assert tally.snapshot().messages_in == 1
