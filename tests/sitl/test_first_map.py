"""When a recording waits for its first map, and how far drones are apart by then."""

from dataclasses import replace

import numpy as np
import pytest

from sitl.absences import Absence
from sitl.fly import first_map_timeout_s
from sitl.pacing import gate, instants
from sitl.plan import FlightPlan, FlyOptions, plan_flight
from tests.sitl.flights import Flight, at_ns, ned_from_body, write_recording
from vcl_companion.errors import ConfigError
from vcl_companion.recording import Drone, KnownPair, Recording, read_recording

N_FRAMES = 30  # five a second: of six seconds
OF_TRUTH = (KnownPair("mav0", "mav1"),)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    path = tmp_path_factory.mktemp("long") / "three"
    return read_recording(write_recording(path, Flight(n_frames=N_FRAMES, n_drones=3)))


def beginning_with(recording: Recording, frames: dict[str, slice]) -> Recording:
    """Return a recording of whose drones only some frames are there."""
    return replace(
        recording,
        drones=tuple(
            replace(d, frames=d.frames[frames.get(d.name, slice(None))]) for d in recording.drones
        ),
    )


def planned(
    recording: Recording,
    frames: dict[str, slice],
    pairs: tuple[KnownPair, ...] = OF_TRUTH,
) -> FlightPlan:
    return plan_flight(beginning_with(recording, frames), FlyOptions(known_distances=pairs))


def left_out(plan: FlightPlan) -> dict[str, int]:
    return {drone.name: drone.n_left_out for drone in plan.drones if drone.n_left_out}


def apart_m(one: int, k: int, other: int, n: int) -> float:
    """Return how far a drone's k-th frame is from another's n-th."""
    apart = ned_from_body(one, k).translation - ned_from_body(other, n).translation
    return float(np.linalg.norm(apart))


def test_a_drone_that_begins_long_after_is_not_waited_for(recording: Recording) -> None:
    """The first map is made of the others' frames: its distance is that of these."""
    plan = planned(recording, {"mav2": slice(15, None)})
    assert plan.waited_for == {"mav0", "mav1"}
    assert left_out(plan) == {}
    assert plan.known_distances[0][2] == pytest.approx(apart_m(0, 0, 1, 0), abs=1e-9)


def test_a_drone_that_begins_within_a_second_is_waited_for(recording: Recording) -> None:
    plan = planned(recording, {"mav2": slice(4, None)})
    assert plan.waited_for == {"mav0", "mav1", "mav2"}
    assert left_out(plan) == {"mav0": 4, "mav1": 4}
    assert plan.known_distances[0][2] == pytest.approx(apart_m(0, 4, 1, 4), abs=1e-9)


def test_what_was_seen_before_a_pair_is_there_is_left_out(recording: Recording) -> None:
    """A map of then has no scale; only the newest frames go with those of the pair."""
    plan = planned(recording, {"mav1": slice(15, None)})
    assert plan.waited_for == {"mav0", "mav1", "mav2"}
    # mav2's 15th comes 3 ms after mav1's first: its 14th is not waited with.
    assert left_out(plan) == {"mav0": 15, "mav2": 14}
    assert plan.known_distances[0][2] == pytest.approx(apart_m(0, 15, 1, 15), abs=1e-9)
    assert plan.starts_at_ns == at_ns(2, 14)


def test_until_the_first_map_no_drone_is_given_more_than_one_frame(recording: Recording) -> None:
    """Nobody answers them meanwhile: they would lie unread in the way of all that follows."""
    plan = planned(recording, {"mav1": slice(15, None)})
    moments = instants([drone.frames_at_ns for drone in plan.drones], flat_out=True)
    there = {n for n, drone in enumerate(plan.drones) if drone.name in plan.waited_for}
    given = [due.drone for m in moments[: gate(moments, there) + 1] for due in m.frames]
    assert sorted(given) == [0, 1, 2]


def test_the_pair_that_is_there_first_gives_the_scale(recording: Recording) -> None:
    pairs = (KnownPair("mav0", "mav1"), KnownPair("mav0", "mav2"))
    plan = planned(recording, {"mav1": slice(15, None)}, pairs)
    assert plan.waited_for == {"mav0", "mav2"}
    (_, _, of_late_m), (_, _, of_first_m) = plan.known_distances
    assert of_first_m == pytest.approx(apart_m(0, 0, 2, 0), abs=1e-9)
    assert of_late_m == pytest.approx(apart_m(0, 15, 1, 15), abs=1e-9)


def test_a_pair_that_pauses_is_waited_for_until_it_is_together(recording: Recording) -> None:
    """mav1's first frame lies in a pause of the leader's."""
    paused = pausing(recording, 0, 3, 20)
    drones = (paused, replace(recording.drones[1], frames=recording.drones[1].frames[10:]))
    plan = plan_flight(replace(recording, drones=drones), FlyOptions(known_distances=OF_TRUTH))
    assert left_out(plan) == {"mav0": 3, "mav1": 9}
    assert plan.known_distances[0][2] == pytest.approx(apart_m(0, 20, 1, 19), abs=1e-9)


def pausing(recording: Recording, who: int, until: int, again: int) -> Drone:
    """Return a drone without its frames of some time."""
    drone = recording.drones[who]
    return replace(drone, frames=(*drone.frames[:until], *drone.frames[again:]))


def test_who_pauses_while_the_map_is_made_begins_later(recording: Recording) -> None:
    one, other, third = recording.drones
    begins = (one, replace(other, frames=other.frames[10:]), pausing(recording, 2, 3, 20))
    plan = plan_flight(replace(recording, drones=begins), FlyOptions(known_distances=OF_TRUTH))
    assert plan.waited_for == {"mav0", "mav1"}
    assert left_out(plan) == {"mav0": 10, "mav2": 3}
    assert plan.starts_at_ns == at_ns(0, 10)
    # Of who has no more to come the last one is flown.
    begins = (*begins[:2], replace(third, frames=third.frames[:3]))
    plan = plan_flight(replace(recording, drones=begins), FlyOptions(known_distances=OF_TRUTH))
    assert plan.waited_for == {"mav0", "mav1"}
    assert left_out(plan) == {"mav0": 10, "mav2": 2}


def test_nobody_is_waited_for_whom_the_leader_s_frame_is_too_old_for(recording: Recording) -> None:
    begins = (
        pausing(recording, 0, 1, 20),
        replace(recording.drones[1], frames=recording.drones[1].frames[4:]),
        replace(recording.drones[2], frames=recording.drones[2].frames[8:]),
    )
    plan = plan_flight(replace(recording, drones=begins), FlyOptions(known_distances=OF_TRUTH))
    assert plan.waited_for == {"mav0", "mav1"}
    assert left_out(plan) == {}
    assert plan.known_distances[0][2] == pytest.approx(apart_m(0, 0, 1, 4), abs=1e-9)


def test_who_is_late_is_given_what_there_is_then(recording: Recording) -> None:
    late = FlyOptions(known_distances=OF_TRUTH, absences=(Absence("mav2", 0.0, 3.0),))
    plan = plan_flight(recording, late)
    assert plan.waited_for == {"mav0", "mav1"}
    assert left_out(plan) == {}


def test_drones_that_are_never_together_are_one_line(recording: Recording) -> None:
    with pytest.raises(ConfigError) as raised:
        planned(recording, {"mav0": slice(0, 10), "mav1": slice(20, None)})
    assert str(raised.value) == (
        "mav0, mav1: have no frames within a second of each other, and a first map is made of such"
    )


def test_one_alone_waits_for_nobody(recording: Recording) -> None:
    begun = beginning_with(recording, {})
    plan = plan_flight(begun, FlyOptions(drones=("mav1",)))
    assert plan.waited_for == {"mav1"}
    assert left_out(plan) == {}


def test_a_map_has_longer_where_frames_are_asked_for_that_are_yet_to_come(
    recording: Recording,
) -> None:
    options = FlyOptions(known_distances=OF_TRUTH)
    begin_later = planned(recording, {"mav2": slice(15, None)})
    started_later = replace(options, absences=(Absence("mav2", 0.0, 3.0),))
    as_ever = plan_flight(recording, options), plan_flight(recording, started_later)
    assert first_map_timeout_s(begin_later) == options.start_timeout_s + 20.0
    assert [first_map_timeout_s(plan) for plan in as_ever] == [options.start_timeout_s] * 2
