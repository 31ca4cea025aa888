"""A drone that turns away from the map and goes on by its own frames, and its return."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from tests.checks import nees
from tests.daemon import demo
from tests.daemon.test_turning_away import OPTIONS, chart, n_in_view
from tests.daemon.waiting import run
from tests.localization.painted import MOUNTING, photograph
from tests.scenes import PINHOLE
from vcl_companion.cameras.source import Frame
from vcl_companion.daemon.estimator import Estimator
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.odometry import Odometry
from vcl_companion.daemon.workshop import WorkOptions, Workshop
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, exp_so3, matrix_from_euler
from vcl_companion.localization.filter_state import FilterState
from vcl_companion.localization.fix import Localized, NotLocalized, Prior, Recognised
from vcl_companion.localization.map_index import MapIndex
from vcl_companion.localization.pipeline import follow, follow_own_views, localize
from vcl_companion.localization.pose_filter import FilterOptions
from vcl_companion.mapping.local_map import LocalMap
from vcl_companion.mapping.options import NoMap
from vcl_companion.mapping.templates import Templates
from vcl_companion.recording.sensor import Sensor
from vcl_companion.swarm.pose_requests import InterMavOptions

DRONE, PER_S, LENGTH_S = 7, 10, 9.0
# Turned by 105 degrees and back; what the map shows is out of sight by 90.
LEAVES_S, TURNS_S, RETURNS_S = 0.8, 3.4, 5.2
MOTION = FilterOptions()
SENSOR = Sensor(PINHOLE, MOUNTING, float(PER_S))
WORLD = b"world", 0


def truth_at(at_s: float) -> Pose:
    share = np.clip((at_s - LEAVES_S) / TURNS_S, 0, 1) - np.clip((at_s - RETURNS_S) / TURNS_S, 0, 1)
    heading = float(np.deg2rad(105.0) * share**2 * (3.0 - 2.0 * share))
    gone = np.array([-1.5 + 0.3 * at_s, 0.5 - 0.25 * at_s, -0.3])
    return Pose(matrix_from_euler(0.02 * np.sin(3 * at_s), -0.03 * np.sin(2 * at_s), heading), gone)


@dataclass(frozen=True, eq=False)
class Flown:
    """One frame: its truth, what was seen, and what was believed after it."""

    at_s: float
    fix: Localized | NotLocalized
    state: FilterState | None
    has_local_map: bool

    @property
    def error(self) -> Array:
        assert self.state is not None, self.fix
        return truth_at(self.at_s).local(self.state.world_from_body)


class Failing(Workshop):
    """Makes no local map."""

    def local_map(self, *_: object) -> LocalMap | NoMap:
        raise np.linalg.LinAlgError("singular")


def keeping(shop: type[Workshop] = Workshop) -> tuple[Odometry, MapWork]:
    """Return what keeps local maps, and what makes them."""
    options = WorkOptions((), demo.MAP_OPTIONS, OPTIONS, ("akaze",), InterMavOptions(), True)
    work = MapWork(shop(SENSOR, options), forks=False)
    return Odometry(SENSOR, DRONE, work), work


@asynccontextmanager
async def making(shop: type[Workshop] = Workshop) -> AsyncIterator[Odometry]:
    """Have local maps made where they are wanted."""
    odometry, work = keeping(shop)
    task = asyncio.create_task(odometry.run())
    try:
        yield odometry
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task
        work.end()


def anywhere(index: MapIndex, templates: Templates, sigma_m: float) -> tuple[MapIndex, Templates]:
    """Return a map all of which may be somewhere else, as after a long flight."""
    landmark_map = index.landmark_map
    moved = np.vstack([k.world_from_body.rotation.T for k in landmark_map.keyframes])
    common = np.zeros((6 * len(landmark_map.keyframes), 3))
    common.reshape(-1, 6, 3)[:, :3] = moved.reshape(-1, 3, 3)
    known = index.uncertainty.keyframe_covariance + sigma_m**2 * common @ common.T
    sure = replace(index.uncertainty, keyframe_covariance=known)
    return replace(index, uncertainty=sure), replace(templates, uncertainty=sure)


async def flown(
    rng: np.random.Generator,
    *,
    goes_on: bool,
    shop: type[Workshop] = Workshop,
    hidden: tuple[float, float] = (0.0, 0.0),
    vague_m: float = 0.0,
    most_m: float = OPTIONS.localization.max_sigma_m,
) -> list[Flown]:
    """Fly there and back; with or without going on by own frames where the map ends.

    For the time ``hidden``, s, the map shows nothing. All of it may be so far off, 1 sigma. Poses
    by the map are believed if they are sure to ``most_m``.
    """
    index, templates = chart()
    if vague_m:
        index, templates = anywhere(index, templates, vague_m)
    belief = replace(OPTIONS.localization, max_sigma_m=most_m)
    options = replace(OPTIONS, localization=belief, drone_id=DRONE)
    estimator = Estimator(MOTION, OPTIONS.localization, lambda _: None)
    out = []
    async with making(shop) as odometry:
        for k in range(round(LENGTH_S * PER_S)):
            at_s, at_ns = k / PER_S, round(k / PER_S * 1e9)
            image = photograph(truth_at(at_s), rng)
            attitude = truth_at(at_s).rotation @ exp_so3(0.005 * rng.standard_normal(3))
            predicted = estimator.predicted(at_ns, attitude)
            # On the map, too; daemons look there from ``prior()``, and half a metre off lose it.
            prior = predicted.priors_on_own_views()[0] if predicted else None
            given = image, PINHOLE, MOUNTING
            fix, seen = localize(*given, index, templates, prior, attitude, options), templates
            if hidden[0] <= at_s < hidden[1]:
                fix = NotLocalized("0 landmarks in view, 15 needed")
            local = odometry.templates
            if goes_on and local is None and isinstance(fix, NotLocalized):
                local = await odometry.begun(WORLD)
            if goes_on and local is not None and prior is not None and odometry.may_tell_more(fix):
                own = follow_own_views(*given, local, prior, attitude, options)
                if isinstance(own, Localized) and odometry.tells_more(own, fix):
                    fix, seen = own, local
            state: FilterState | NotLocalized | None = None
            if isinstance(fix, Localized):
                state = estimator.take_fix(predicted, fix, at_ns, attitude)
                if isinstance(state, FilterState) and fix.by != "features":
                    odometry.note(Frame(image, at_ns, k, 0), fix, seen, WORLD)
            else:
                estimator.take_nothing(predicted, at_ns, attitude)
            await odometry.settled()  # here, where no time passes, before the next frame
            believed = state if isinstance(state, FilterState) else None
            out.append(Flown(at_s, fix, believed, odometry.templates is not None))
    return out


def by(frame: Flown) -> str:
    return frame.fix.by if isinstance(frame.fix, Localized) else ""


def test_every_frame_is_found_though_the_map_ends() -> None:
    frames = asyncio.run(flown(np.random.default_rng(5), goes_on=True))
    assert min(n_in_view(truth_at(f.at_s)) for f in frames) < 15
    away = [f for f in frames if by(f) == "odometry"]
    assert len(away) >= 10
    assert all(by(f) in ("patches", "odometry") for f in frames[1:])
    squared = []
    for f in away:
        assert f.state is not None
        assert np.linalg.norm(f.error[:3]) < 0.1
        assert np.rad2deg(np.linalg.norm(f.error[3:])) < 0.3
        squared.append(float(nees(f.error, f.state.pose_covariance())[0]))
    # 99.99 % of chi^2 with 6 degrees of freedom.
    assert max(squared) < 27.9
    # Back on the map, it is that again that is believed, and no local map is kept.
    back = frames[-10:]
    assert all(by(f) == "patches" for f in back)
    assert not back[-1].has_local_map
    assert max(np.linalg.norm(f.error[:3]) for f in back) < 0.03


def test_without_own_frames_it_is_lost() -> None:
    """What the test above is about: the map alone does not do it."""
    frames = asyncio.run(flown(np.random.default_rng(5), goes_on=False))
    assert sum(by(f) == "" for f in frames) >= 10


def test_who_sees_nothing_of_the_map_from_one_frame_to_the_next_goes_on_too() -> None:
    """No local map was wanted: the map had filled the image."""
    gone = 2.0, 3.5
    for goes_on in (True, False):
        frames = asyncio.run(flown(np.random.default_rng(5), goes_on=goes_on, hidden=gone))
        before = [f for f in frames if f.at_s < gone[0]]
        assert not any(f.has_local_map for f in before)
        lost = [f for f in frames if gone[0] <= f.at_s < gone[1]]
        assert {by(f) for f in lost} == {"odometry" if goes_on else ""}
        for f in lost if goes_on else ():
            assert f.state is not None
            assert float(nees(f.error, f.state.pose_covariance())[0]) < 27.9
            assert np.linalg.norm(f.error[:3]) < 0.05


def test_who_does_not_know_where_all_of_it_is_goes_on_no_less_well() -> None:
    """A map that is half a metre off after a long flight: own frames are off as it is."""
    frames = asyncio.run(flown(np.random.default_rng(5), goes_on=True, vague_m=0.5))
    away = [f for f in frames if by(f) == "odometry"]
    assert len(away) >= 10
    assert all(by(f) in ("patches", "odometry") for f in frames[1:])
    for f in frames[1:]:
        assert np.linalg.norm(f.error[:3]) < 0.1
    for f in away:
        assert f.state is not None
        told_m = np.sqrt(np.diag(f.state.pose_covariance())[:3])
        assert np.all((told_m > 0.45) & (told_m < 0.6))


def test_by_own_frames_it_goes_on_where_a_pose_by_the_map_would_be_too_vague() -> None:
    """What they are off they are off alike: refused, nothing would lead back to the map."""
    most_m = 0.015
    frames = asyncio.run(flown(np.random.default_rng(5), goes_on=True, most_m=most_m))
    assert all(by(f) in ("patches", "odometry") for f in frames[1:])
    assert by(frames[-1]) == "patches"
    told_m = [
        np.sqrt(np.linalg.eigvalsh(f.state.pose_covariance()[:3, :3])[-1])
        for f in frames
        if f.state is not None and by(f) == "odometry"
    ]
    assert max(told_m) > 2.0 * most_m


def test_a_lost_frame_does_not_wait_for_long() -> None:
    """Nobody makes the local map; the loop's time is all that passes."""

    async def scenario() -> None:
        _, templates = chart()
        odometry, work = keeping()
        truth = truth_at(0.0)
        image = photograph(truth, np.random.default_rng(1))
        where = Prior(truth, np.diag(np.repeat([0.01, 0.001], 3) ** 2))
        fix = follow(image, PINHOLE, MOUNTING, templates, where, None, OPTIONS)
        assert isinstance(fix, Localized)
        odometry.note(Frame(image, 0, 0, 0), replace(fix, covered=0.8), templates, WORLD)
        assert await odometry.begun(WORLD) is None
        work.end()

    run(scenario())


def test_frames_of_another_world_begin_nothing() -> None:
    async def scenario() -> None:
        _, templates = chart()
        async with making() as odometry:
            assert await odometry.begun(WORLD) is None  # nor does none
            for k in range(5):
                truth = truth_at(1.0 + 0.3 * k)
                image = photograph(truth, np.random.default_rng(k))
                where = Prior(truth, np.diag(np.repeat([0.01, 0.001], 3) ** 2))
                fix = follow(image, PINHOLE, MOUNTING, templates, where, None, OPTIONS)
                assert isinstance(fix, Localized)
                told = replace(fix, covered=0.8)
                odometry.note(Frame(image, k * 10**8, k, 0), told, templates, WORLD)
            assert await odometry.begun((b"world", 1)) is None
            assert await odometry.begun((b"another", 0)) is None
            assert odometry.templates is None
            assert await odometry.begun(WORLD) is odometry.templates is not None

    run(scenario())


@pytest.mark.parametrize("n_jumps", [1, 2])
@pytest.mark.parametrize("own_frames", [0, 3])
def test_who_was_elsewhere_goes_on_by_own_frames_from_there(n_jumps: int, own_frames: int) -> None:
    """Where own frames had led it; where the map had put it, it was, and flew as nobody thought."""

    async def scenario() -> None:
        _, templates = chart()
        by = Pose(exp_so3(np.array([0.0, 0.0, 0.1])), np.array([2.0, -3.0, 0.4]))
        small = np.diag(np.repeat([0.01, 0.001], 3) ** 2)
        async with making() as odometry:
            for k in range(5 + own_frames):
                truth = truth_at(1.0 + 0.3 * k)
                image = photograph(truth, np.random.default_rng(k))
                where = Prior(truth, small)
                local = odometry.templates if k >= 5 else None
                look, seen = (follow, templates) if local is None else (follow_own_views, local)
                fix = look(image, PINHOLE, MOUNTING, seen, where, None, OPTIONS)
                assert isinstance(fix, Localized)
                assert fix.is_on_map == (k < 5)
                told = replace(fix, covered=0.8 if k < 5 else 0.3)
                odometry.note(Frame(image, k * 10**8, k, 0), told, seen, WORLD)
                await odometry.settled()
                if k == 4:
                    assert await odometry.begun(WORLD) is not None
            world = WORLD[0], n_jumps
            odometry.displaced(by, by @ truth, small, world)
            assert odometry.templates_in(world) is None
            local = await odometry.begun(world)
            # Of two jumps at once nobody knows where the first one led.
            assert (local is not None) == (n_jumps == 1)
            if local is None:
                return
            next_one = truth_at(1.0 + 0.3 * (5 + own_frames) - 0.2)
            image = photograph(next_one, np.random.default_rng(9))
            expected_at = by @ next_one if own_frames else next_one
            expected = Prior(expected_at.retracted(0.01 * np.ones(6)), 4.0 * small)
            found = follow_own_views(image, PINHOLE, MOUNTING, local, expected, None, OPTIONS)
            assert isinstance(found, Localized)
            off = expected_at.local(found.world_from_body)
            assert np.linalg.norm(off[:3]) < 0.1
            assert np.linalg.norm(off[3:]) < 0.01
            assert nees(off, found.covariance()) < 25.0

    run(scenario())


def test_where_no_local_map_can_be_made_it_flies_on_by_the_map() -> None:
    frames = asyncio.run(flown(np.random.default_rng(5), goes_on=True, shop=Failing))
    assert "odometry" not in {by(f) for f in frames}
    assert sum(by(f) == "" for f in frames) >= 10
    assert by(frames[-1]) == "patches"
    assert not any(f.has_local_map for f in frames)


def test_a_new_map_that_shows_little_of_the_place_ends_no_odometry() -> None:
    async def scenario() -> None:
        _, templates = chart()
        async with making() as odometry:
            small = np.diag(np.repeat([0.01, 0.001], 3) ** 2)
            another = templates.uncertainty.keyframe_covariance.copy()
            for k, (covered, is_kept) in enumerate(
                [(0.8, False), (0.6, False), (0.5, True), (0.5, True), (0.2, True), (0.75, False)]
            ):
                truth = truth_at(1.5 + 0.3 * k)
                image = photograph(truth, np.random.default_rng(k))
                where = Prior(truth, small)
                fix = follow(image, PINHOLE, MOUNTING, templates, where, None, OPTIONS)
                assert isinstance(fix, Localized)
                keyframes = another if k >= 4 else fix.keyframe_covariance
                told = replace(fix, covered=covered, keyframe_covariance=keyframes)
                odometry.note(Frame(image, k * 10**8, k, 0), told, templates, (b"world", 0))
                await odometry.settled()
                assert (odometry.templates is not None) == is_kept, k

    run(scenario())


@pytest.mark.parametrize(
    ("own", "on_map", "is_own"),
    [
        ((0.4, 0.002), (0.3, 0.025), True),  # few patches of the map, close together
        ((0.4, 0.002), (0.3, 0.003), False),
        ((0.1, 0.002), (0.3, 0.003), True),
        ((0.1, 0.002), (0.09, 0.002), False),
    ],
)
def test_the_surer_one_is_believed_and_none_that_hardly_knows_how_it_is_turned(
    own: tuple[float, float], on_map: tuple[float, float], is_own: bool
) -> None:
    _, templates = chart()
    odometry, work = keeping()
    truth = truth_at(0.0)

    def told(sigmas: tuple[float, float]) -> Localized:
        covariance = np.diag(np.repeat(sigmas, 3) ** 2)
        no_map = np.zeros((6, 6))
        return Localized(truth, covariance, no_map, no_map, no_map, 99, 90, True, 0.1, by="patches")

    odometry.note(
        Frame(photograph(truth, np.random.default_rng(1)), 0, 0, 0),
        told(on_map),
        templates,
        (b"", 0),
    )
    assert odometry.tells_more(told(own), told(on_map)) == is_own
    assert odometry.tells_more(told(own), NotLocalized("no landmark in view"))
    work.end()


def test_a_jump_to_where_own_frames_lead_is_no_end_of_these() -> None:
    said: list[str] = []
    estimator = Estimator(MOTION, OPTIONS.localization, said.append)
    sharp, none = np.diag(np.repeat([0.01, 0.001], 3) ** 2), np.zeros((6, 6))

    def takes(k: int, east_m: float, recognised: Recognised) -> tuple[int, int]:
        there = Pose(np.eye(3), np.array([0.0, east_m, 0.0]))
        keyframes = none if recognised == "patches" else sharp
        fix = Localized(there, sharp, none, none, keyframes, 99, 90, True, 0.1, by=recognised)
        predicted = estimator.predicted(k * 10**8, np.eye(3))
        assert isinstance(estimator.take_fix(predicted, fix, k * 10**8, np.eye(3)), FilterState)
        return estimator.n_resets, estimator.n_displaced

    for k in range(10):
        assert takes(k, 0.0, "patches") == (0, 0)
    assert takes(10, 3.0, "patches") == (1, 1)
    assert takes(11, 3.0, "odometry") == (1, 1)
    assert takes(12, 0.0, "odometry") == (2, 1)
    assert len(said) == 2


@pytest.mark.parametrize("gap_s", [0.0, 0.01])
def test_frames_that_bring_nothing_are_not_kept(gap_s: float) -> None:
    """Hovering; and one that is told again."""

    async def scenario() -> None:
        _, templates = chart()
        odometry, work = keeping()
        truth = truth_at(0.0)
        image = photograph(truth, np.random.default_rng(1))
        prior_covariance = np.diag(np.repeat([0.01, 0.001], 3) ** 2)
        fix = follow(
            image, PINHOLE, MOUNTING, templates, Prior(truth, prior_covariance), None, OPTIONS
        )
        assert isinstance(fix, Localized)
        for k in range(30):
            frame = Frame(image, round(k * gap_s * 1e9), k, 0)
            odometry.note(frame, fix, templates, (b"world", 0))
        assert len(odometry._window.views) == 1
        odometry.note(Frame(image, 10**12, 99, 0), fix, templates, (b"another", 0))
        assert len(odometry._window.views) == 1
        work.end()

    run(scenario())


def found_turned(
    turned_deg: float, k: int, index: MapIndex, templates: Templates
) -> tuple[Frame, Localized]:
    """Return the k-th frame, of a drone that has turned on the spot, and what the map says."""
    turn = exp_so3(np.array([0.0, 0.0, np.deg2rad(turned_deg)]))
    truth = Pose(turn @ truth_at(0.0).rotation, truth_at(0.0).translation)
    image = photograph(truth, np.random.default_rng(k))
    prior = Prior(truth, np.diag(np.repeat([0.01, 0.001], 3) ** 2))
    fix = localize(image, PINHOLE, MOUNTING, index, templates, prior, None, OPTIONS)
    assert isinstance(fix, Localized)
    return Frame(image, k * 10**8, k, 0), fix


@pytest.mark.parametrize(("covered", "made_at"), [(0.6, [4, 7, 10]), (0.45, [4, 6, 8, 10])])
def test_a_local_map_is_made_anew_where_the_last_one_is_left_behind(
    covered: float, made_at: list[int]
) -> None:
    """By eight degrees while the swarm's map is well in sight, by four where it may be gone."""

    async def scenario() -> None:
        index, templates = chart()
        made: list[int] = []

        class Telling(Workshop):
            def local_map(self, *given: Any) -> LocalMap | NoMap:
                made.append(k)
                return super().local_map(*given)

        async with making(Telling) as odometry:
            for k in range(11):
                frame, fix = found_turned(3.0 * k, k, index, templates)
                shown = replace(fix, covered=covered if k else fix.covered)
                odometry.note(frame, shown, templates, WORLD)
                await odometry.settled()
        assert made == made_at

    run(scenario())


@pytest.mark.parametrize(("first", "made_of"), [(0, [6, 5, 3, 1]), (3, [6, 5, 4, 3])])
def test_a_local_map_is_made_of_views_far_apart_where_there_are_some(
    first: int, made_of: list[int]
) -> None:
    """By a short way between them it is hardly told how far things are."""

    async def scenario() -> None:
        index, templates = chart()
        made: list[list[int]] = []

        class Telling(Workshop):
            def local_map(self, images: Any, *given: Any) -> LocalMap | NoMap:
                made.append([image.captured_at_ns // 10**8 for image in images])
                return super().local_map(images, *given)

        async with making(Telling) as odometry:
            for k in range(first, 7):
                frame, fix = found_turned(9.0 * (k - first), k, index, templates)
                shown = replace(fix, covered=0.95 if k < 6 else 0.4)
                odometry.note(frame, shown, templates, WORLD)
            await odometry.settled()
        assert made == [made_of]

    run(scenario())
