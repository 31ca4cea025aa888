"""The autopilot link against the other side of a socket that is played by hand."""

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator

import numpy as np
import pytest

from tests.daemon.waiting import hurry, run, until
from tests.links import wire
from tests.links.running import Udp, running, udp
from vcl_companion.clock import ManualClock
from vcl_companion.errors import ConfigError
from vcl_companion.geometry.pose import Pose, euler_pose_covariance
from vcl_companion.geometry.rotation import Array, exp_so3, log_so3, quaternion_from_matrix
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.autopilot_options import AutopilotOptions, ServiceState
from vcl_companion.links.reconnect import Address
from vcl_companion.links.texts import Severity
from vcl_companion.links.vision_pose import PoseEstimate

MS = 1_000_000
NOW_NS = 1_403_636_579_763_555_584
BOOT_NS = NOW_NS - 90_000 * MS  # the autopilot's start, in our time: the offset
SYSTEM = 7


class FakeAutopilot:
    """The other end: reads what comes, says what a test tells it."""

    def __init__(self, side: Udp) -> None:
        self._side = side
        self._companion: Address | None = None

    async def next_of(self, message_id: int) -> wire.Seen:
        while True:
            data, self._companion = await self._side.got.get()
            (seen,) = wire.read(data)
            if seen.message_id == message_id:
                return seen

    def say(self, data: bytes) -> None:
        self._side.transport.sendto(data, self._companion)

    async def answer_question(self) -> None:
        question = await self.next_of(wire.TIMESYNC)
        tc1_ns, ts1_ns = question.fields
        assert tc1_ns == 0
        assert isinstance(ts1_ns, int)
        self.say(wire.packed(wire.TIMESYNC, ts1_ns - BOOT_NS, ts1_ns, system=SYSTEM))

    def measure(self, at_ns: int, rotation: Array, yaw_rate_deg_s: float = 0.0) -> None:
        boot_ms = (at_ns - BOOT_NS) // MS
        quaternion = quaternion_from_matrix(rotation).tolist()
        fields = (boot_ms, *quaternion, 0, 0, math.radians(yaw_rate_deg_s), 0, 0, 0, 0)
        self.say(wire.packed(wire.ATTITUDE_QUATERNION, *fields, system=SYSTEM))


@contextlib.asynccontextmanager
async def linked(
    clock: ManualClock, max_age_s: float = 0.1
) -> AsyncIterator[tuple[AutopilotLink, FakeAutopilot]]:
    async with udp() as side:
        options = AutopilotOptions(link=f"udp:127.0.0.1:{side.port}", max_attitude_age_s=max_age_s)
        link = AutopilotLink(options, SYSTEM, clock)
        async with running(link.run()):
            yield link, FakeAutopilot(side)


def turned(degrees: float) -> Array:
    return exp_so3(np.deg2rad([0.0, 0.0, degrees]))


def degrees_off(actual: Array, expected: Array) -> float:
    return math.degrees(float(np.linalg.norm(log_so3(expected.T @ actual))))


def test_it_introduces_itself_at_once() -> None:
    async def scenario() -> None:
        async with linked(ManualClock(NOW_NS)) as (link, autopilot):
            link.set_state(ServiceState.ACTIVE)
            beat = await autopilot.next_of(wire.HEARTBEAT)
            assert (beat.system, beat.component) == (SYSTEM, 197)
            assert beat.fields == (0, 18, 8, 0, 4, 3)
            wish = await autopilot.next_of(wire.COMMAND_LONG)
            assert wish.fields == (31, 20000, 0, 0, 0, 0, 0, 511, SYSTEM, 1, 0)

    asyncio.run(scenario())


def test_questions_about_time_are_answered_by_our_clock() -> None:
    clock = ManualClock(NOW_NS)

    async def scenario() -> None:
        async with linked(clock) as (_, autopilot):
            await autopilot.next_of(wire.TIMESYNC)
            clock.advance_to(NOW_NS + 5)
            autopilot.say(wire.packed(wire.TIMESYNC, 0, 424_242, system=SYSTEM))
            while True:
                answer = await autopilot.next_of(wire.TIMESYNC)
                if answer.fields[0] != 0:
                    assert answer.fields == (NOW_NS + 5, 424_242)
                    return

    asyncio.run(scenario())


def test_attitude_is_interpolated_in_our_time() -> None:
    async def scenario() -> None:
        async with linked(ManualClock(NOW_NS)) as (link, autopilot):
            await autopilot.answer_question()
            autopilot.measure(NOW_NS - 20 * MS, turned(170.0))
            autopilot.measure(NOW_NS, turned(-170.0))
            attitude = await link.attitudes.at(NOW_NS - 5 * MS, 5.0)
            assert attitude is not None
            # Stamps are cut to milliseconds: 1 degree each here.
            assert degrees_off(attitude.ned_from_body, turned(-175.0)) < 1.0

    asyncio.run(scenario())


def test_attitude_waits_for_the_sample_that_is_on_its_way() -> None:
    async def scenario() -> None:
        async with linked(ManualClock(NOW_NS)) as (link, autopilot):
            await autopilot.answer_question()
            autopilot.measure(NOW_NS - 20 * MS, turned(10.0))
            early = asyncio.create_task(link.attitudes.at(NOW_NS - 20 * MS, 5.0))
            assert (await early) is not None
            late = asyncio.create_task(link.attitudes.at(NOW_NS, 5.0))
            await asyncio.sleep(0)
            assert not late.done()
            autopilot.measure(NOW_NS, turned(20.0))
            attitude = await late
            assert attitude is not None
            assert degrees_off(attitude.ned_from_body, turned(20.0)) < 0.6

    asyncio.run(scenario())


def test_attitude_that_does_not_come_is_by_what_the_last_felt_or_none() -> None:
    async def scenario() -> None:
        async with linked(ManualClock(NOW_NS)) as (link, autopilot):
            assert await link.attitudes.at(NOW_NS, 0.0) is None
            await autopilot.answer_question()
            autopilot.measure(NOW_NS, turned(10.0), yaw_rate_deg_s=100.0)
            assert await link.attitudes.at(NOW_NS, 5.0) is not None
            later = await link.attitudes.at(NOW_NS + 90 * MS, 0.0)
            assert later is not None
            assert degrees_off(later.ned_from_body, turned(19.0)) < 0.1
            assert await link.attitudes.at(NOW_NS + 110 * MS, 0.001) is None

    asyncio.run(scenario())


@pytest.mark.parametrize(("is_told", "expected_deg"), [(False, 50.0), (True, 10.0)])
def test_a_north_that_is_found_before_our_first_pose_is_its_own(
    is_told: bool, expected_deg: float
) -> None:
    async def scenario() -> None:
        async with linked(ManualClock(NOW_NS)) as (link, autopilot):
            await autopilot.answer_question()
            for k in range(5):
                autopilot.measure(NOW_NS + k * 20 * MS, turned(10.0))
            assert await link.attitudes.at(NOW_NS + 80 * MS, 5.0) is not None
            if is_told:
                assert link.poses.send(at_rest(Pose.identity(), np.eye(6))) is None
            for k in range(5, 10):
                autopilot.measure(NOW_NS + k * 20 * MS, turned(50.0))
            attitude = await link.attitudes.at(NOW_NS + 180 * MS, 5.0)
            assert attitude is not None
            assert degrees_off(attitude.ned_from_body, turned(expected_deg)) < 0.6

    asyncio.run(scenario())


def test_quaternions_are_preferred_to_angles() -> None:
    async def scenario() -> None:
        async with linked(ManualClock(NOW_NS)) as (link, autopilot):
            await autopilot.answer_question()
            boot_ms = (NOW_NS - BOOT_NS) // MS
            yaw = math.radians(30.0)
            angles = wire.packed(wire.ATTITUDE, boot_ms, 0, 0, yaw, 0, 0, 0, system=SYSTEM)
            autopilot.say(angles)
            by_angles = await link.attitudes.at(NOW_NS, 5.0)
            assert by_angles is not None
            assert degrees_off(by_angles.ned_from_body, turned(30.0)) < 1e-4
            autopilot.measure(NOW_NS, turned(40.0))
            autopilot.measure(NOW_NS + 20 * MS, turned(40.0))
            later = wire.packed(wire.ATTITUDE, boot_ms + 40, 0, 0, yaw, 0, 0, 0, system=SYSTEM)
            autopilot.say(later)
            attitude = await link.attitudes.at(NOW_NS + 20 * MS, 5.0)
            assert attitude is not None
            assert degrees_off(attitude.ned_from_body, turned(40.0)) < 1e-4

    asyncio.run(scenario())


def test_an_autopilot_without_timesync_is_timed_by_arrival() -> None:
    async def scenario() -> None:
        clock = ManualClock(NOW_NS)
        async with linked(clock) as (link, autopilot):
            await autopilot.next_of(wire.TIMESYNC)
            autopilot.measure(NOW_NS, turned(10.0))
            assert await link.attitudes.at(NOW_NS, 0.05) is None
            for _ in range(10):
                await autopilot.next_of(wire.TIMESYNC)
            assert link.attitudes.newest_ns() == NOW_NS - 10 * MS
            assert await link.attitudes.at(NOW_NS - 10 * MS, 0.0) is not None

    asyncio.run(scenario())


def test_a_restarted_autopilot_is_timed_anew() -> None:
    async def scenario() -> None:
        async with linked(ManualClock(NOW_NS)) as (link, autopilot):
            await autopilot.answer_question()
            autopilot.measure(NOW_NS, turned(10.0))
            assert await link.attitudes.at(NOW_NS, 5.0) is not None
            restarted = wire.packed(
                wire.ATTITUDE_QUATERNION, 3000, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, system=SYSTEM
            )
            for _ in range(2):  # asked for as the link came up
                await autopilot.next_of(wire.COMMAND_LONG)
            autopilot.say(restarted)
            while link.attitudes.round_trip_s is not None:
                await asyncio.sleep(0.01)
            # It has forgotten what it was asked to send.
            async with asyncio.timeout(0.8):  # else asked for after a second
                assert (await autopilot.next_of(wire.COMMAND_LONG)).fields[7] == 511
            question = await autopilot.next_of(wire.TIMESYNC)
            answer = wire.packed(wire.TIMESYNC, 3000 * MS, question.fields[1], system=SYSTEM)
            autopilot.say(answer)
            attitude = await link.attitudes.at(NOW_NS, 5.0)
            assert attitude is not None
            assert degrees_off(attitude.ned_from_body, np.eye(3)) < 1e-4

    asyncio.run(scenario())


def test_only_the_own_autopilot_is_heard() -> None:
    async def scenario() -> None:
        async with linked(ManualClock(NOW_NS)) as (link, autopilot):
            await autopilot.answer_question()
            fields = (90_000, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0)
            autopilot.say(wire.packed(wire.ATTITUDE_QUATERNION, *fields, system=8))
            autopilot.say(
                wire.packed(wire.ATTITUDE_QUATERNION, *fields, system=SYSTEM, component=190)
            )
            autopilot.say(b"garbage")
            autopilot.measure(NOW_NS + 100 * MS, turned(10.0))
            attitude = await link.attitudes.at(NOW_NS + 100 * MS, 5.0)
            assert attitude is not None
            assert degrees_off(attitude.ned_from_body, turned(10.0)) < 0.1
            refused = link.counters.refused
            assert refused == {"another system": 1, "another component": 1, "garbage bytes": 7}

    asyncio.run(scenario())


def some_pose() -> tuple[Pose, Array]:
    rng = np.random.default_rng(5)
    root = rng.normal(size=(6, 6)) * [0.1, 0.1, 0.1, 0.01, 0.01, 0.01]
    return Pose(exp_so3(np.array([0.2, -0.4, 2.0])), np.array([1.5, -2.5, -30.0])), root.T @ root


def at_rest(pose: Pose, covariance: Array, at_ns: int = NOW_NS, resets: int = 0) -> PoseEstimate:
    return PoseEstimate(pose, covariance, np.zeros(3), np.eye(3), at_ns, resets)


def test_a_pose_goes_out_with_its_own_time_and_covariance() -> None:
    pose, covariance = some_pose()

    async def scenario() -> wire.Seen:
        async with linked(ManualClock(NOW_NS)) as (link, autopilot):
            await autopilot.next_of(wire.HEARTBEAT)
            assert link.poses.send(at_rest(pose, covariance, NOW_NS - 12_345_678, 258)) is None
            return await autopilot.next_of(wire.VISION_POSITION_ESTIMATE)

    seen = asyncio.run(scenario())
    assert seen.fields[0] == (NOW_NS - 12_345_678) // 1000
    np.testing.assert_allclose(seen.fields[1:4], pose.translation, rtol=1e-7)
    roll, pitch, yaw = (float(angle) for angle in seen.fields[4:7])
    expected_yaw = math.atan2(pose.rotation[1, 0], pose.rotation[0, 0])
    assert math.isclose(yaw, expected_yaw, rel_tol=1e-6)
    assert math.isclose(pitch, -math.asin(pose.rotation[2, 0]), rel_tol=1e-6)
    assert math.isclose(roll, math.atan2(pose.rotation[2, 1], pose.rotation[2, 2]), rel_tol=1e-6)
    expected = euler_pose_covariance(pose, covariance)[np.triu_indices(6)]
    np.testing.assert_allclose(seen.fields[7:28], expected, rtol=1e-6)
    assert seen.fields[28] == 1 + (NOW_NS // 1_000_000_000 + 258) % 255


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e39, -1.0])
def test_a_pose_that_would_harm_is_not_sent(bad: float) -> None:
    pose, covariance = some_pose()
    covariance[2, 2] = bad

    async def scenario() -> None:
        async with linked(ManualClock(NOW_NS)) as (link, autopilot):
            await autopilot.next_of(wire.HEARTBEAT)
            assert link.poses.send(at_rest(pose, covariance)) is not None
            assert link.poses.send(at_rest(pose, np.eye(6))) is None
            assert (await autopilot.next_of(wire.VISION_POSITION_ESTIMATE)).fields[28] > 0
            (reason,) = [r for r in link.counters.refused if r.startswith("pose not sent")]
            assert link.counters.refused[reason] == 1

    asyncio.run(scenario())


def test_rounding_below_zero_is_sent_as_zero() -> None:
    covariance = np.diag([1.0, 1.0, -1e-12, 1.0, 1.0, 1.0])

    async def scenario() -> None:
        async with linked(ManualClock(NOW_NS)) as (link, autopilot):
            await autopilot.next_of(wire.HEARTBEAT)
            assert link.poses.send(at_rest(Pose.identity(), covariance)) is None
            seen = await autopilot.next_of(wire.VISION_POSITION_ESTIMATE)
            diagonal = [seen.fields[7 + k] for k in (0, 6, 11, 15, 18, 20)]
            assert diagonal == [1, 1, 0, 1, 1, 1]

    asyncio.run(scenario())


def test_texts_are_chunked_and_never_repeated() -> None:
    texts = ["lost: 3 inliers", "lost: 3 inliers", "x" * 50, "y" * 50 + "z", "w" * 100, "µ"]

    async def scenario() -> list[wire.Seen]:
        async with linked(ManualClock(NOW_NS)) as (link, autopilot):
            await autopilot.next_of(wire.HEARTBEAT)
            for text in texts:
                link.say(Severity.WARNING, text)
            return [await autopilot.next_of(wire.STATUSTEXT) for _ in range(8)]

    chunks = [seen.fields for seen in asyncio.run(scenario())]
    assert chunks == [
        (4, b"lost: 3 inliers".ljust(50, b"\0"), 0, 0),
        (4, b"x" * 50, 0, 0),
        (4, b"y" * 50, 1, 0),
        (4, b"z".ljust(50, b"\0"), 1, 1),
        (4, b"w" * 50, 2, 0),
        (4, b"w" * 50, 2, 1),
        (4, bytes(50), 2, 2),
        (4, b"?".ljust(50, b"\0"), 0, 0),
    ]


def test_a_stalled_service_has_no_heartbeat() -> None:
    async def scenario() -> None:
        async with udp() as side:
            link = AutopilotLink(
                AutopilotOptions(link=f"udp:127.0.0.1:{side.port}"), SYSTEM, ManualClock(NOW_NS)
            )
            link.set_state(ServiceState.STALLED)
            async with running(link.run()):
                autopilot = FakeAutopilot(side)
                await autopilot.next_of(wire.COMMAND_LONG)
                link.set_state(ServiceState.CRITICAL)
                beat = await autopilot.next_of(wire.HEARTBEAT)
                assert beat.fields[4] == 5
                # The greeting had no beat: a question and the wish for attitude came first.
                assert beat.sequence >= 2

    asyncio.run(scenario())


@pytest.mark.parametrize(
    "options",
    [{"link": "udp:x"}, {"attitude_rate_hz": 0.0}, {"attitude_latency_s": -1.0},
     {"max_attitude_age_s": math.nan}, {"allowed_senders": ("drone",)},
     {"min_rate_hz": 31.0}, {"min_rate_hz": -1.0}, {"max_rate_hz": math.nan},
     {"propagate_s": 3.0}, {"blend_speed_m_s": 0.0}, {"blend_turn_deg_s": 100.0}],
)  # fmt: skip
def test_wrong_options_are_refused(options: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        AutopilotOptions(**options)  # type: ignore[arg-type]


def test_what_is_too_old_is_not_sent_and_what_is_late_is_told_vaguely() -> None:
    pose, _ = some_pose()
    speed = np.array([2.0, 0.0, 0.0])

    def aged(age_s: float) -> PoseEstimate:
        at_ns = NOW_NS - round(age_s * 1e9)
        return PoseEstimate(pose, 1e-4 * np.eye(6), speed, np.eye(3), at_ns, 0)

    async def scenario() -> None:
        async with linked(ManualClock(NOW_NS)) as (link, autopilot):
            await autopilot.next_of(wire.HEARTBEAT)
            assert link.poses.send(aged(2.1)) == "its pose was 2.1 s old"
            assert link.counters.refused["pose not sent: too old"] == 1
            sigmas = []
            for age_s in (0.0, 0.2, 0.7):
                assert link.poses.send(aged(age_s)) is None
                seen = await autopilot.next_of(wire.VISION_POSITION_ESTIMATE)
                sigmas.append(math.sqrt(seen.fields[7]))
            assert sigmas[0] == sigmas[1] < 0.02
            assert math.isclose(sigmas[2], math.hypot(0.01, 2.0 * 0.5), rel_tol=1e-3)

    asyncio.run(scenario())


def test_an_autopilot_that_is_not_heard_is_told_of_once(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")

    async def scenario() -> None:
        async with udp() as side:
            options = AutopilotOptions(link=f"udp:127.0.0.1:{side.port}")
            link, autopilot = (
                AutopilotLink(options, SYSTEM, ManualClock(NOW_NS)),
                FakeAutopilot(side),
            )
            working = asyncio.create_task(link.run())
            await autopilot.answer_question()
            for _ in range(13):
                hurry(1.0)
                await asyncio.sleep(0.002)
            assert not link.is_heard
            autopilot.say(wire.packed(wire.HEARTBEAT, 0, 2, 3, 81, 4, 3, system=SYSTEM))
            await until(lambda: link.is_heard)
            working.cancel()

    run(scenario())
    texts = [record.getMessage() for record in caplog.records]
    silent, heard = (text for text in texts if "heartbeat" in text or "is heard" in text)
    assert silent.startswith("no heartbeat of an autopilot of system 7 in 10 s over udp:127.0.0.1")
    assert heard == "the autopilot is heard"
