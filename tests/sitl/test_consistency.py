"""``python -m sitl consistency``: many maps of a recording, and what poses say of themselves."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from sitl.__main__ import main
from sitl.consistency.chain import Chain, Look
from sitl.consistency.command import ConsistencyOptions, consistency
from sitl.consistency.report import Beginning, nees_of, recording_report
from tests.daemon.demo import DEMO
from vcl_companion.geometry.pose import Pose
from vcl_companion.localization.fix import Localized
from vcl_companion.recording import Trajectory, read_recording


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path, list[str]]:
    """The demo from two instants, each map extended once."""
    out = tmp_path_factory.mktemp("consistency") / "new"
    told: list[str] = []
    report = consistency([DEMO], out, ConsistencyOptions(2, 1), told.append)
    return report, out, told


def test_poses_of_many_maps_err_as_much_as_they_say(
    measured: tuple[dict[str, Any], Path, list[str]],
) -> None:
    report, out, told = measured
    assert report == json.loads((out / "consistency.json").read_text(encoding="utf-8"))
    (of,) = report["recordings"].values()
    assert of["instants"] == len(told) == len(of["nees_median_of_each"]) == 2
    assert of["poses"] > 30
    assert of["lost"] <= of["poses"] // 5
    # A few draws of maps' errors: anything but several times too sure, or too careful.
    assert 0.5 < of["nees_median"] < 15.0
    assert of["within_3_sigma_share"] > 0.9
    assert 1e-4 < of["position_error_m_median"] < 0.05
    alone = of["own_frames"]
    assert alone["poses"] >= 30
    assert alone["lost"] <= alone["poses"] // 5
    assert 0.1 < alone["nees_median"] < 25.0
    assert alone["within_3_sigma_share"] > 0.9
    assert alone["position_error_m_most"] < 0.3
    table = (out / "consistency.md").read_text(encoding="utf-8")
    assert f"| {100 * alone['position_error_m_most']:.1f} |" in table
    assert f"| {of['nees_median']:.1f} |" in table


def test_a_chain_of_maps_is_the_same_every_time() -> None:
    recording = read_recording(DEMO)
    looks = [
        list(islice(Chain(recording, 20, seed=3, novelty_deg=5.0).looks(8, 0), 3)) for _ in range(2)
    ]
    assert [look.drone for look in looks[0]] == [0, 1, 2]
    for one, other in zip(*looks, strict=True):
        assert one.fix is not None
        assert other.fix is not None
        np.testing.assert_array_equal(
            one.fix.world_from_body.matrix(), other.fix.world_from_body.matrix()
        )
        # The leader's place when it began is the world's origin.
        error = one.fix.world_from_body.local(one.true)
        assert np.linalg.norm(error[:3]) < 0.1


def test_maps_are_extended_by_views_that_are_new() -> None:
    chain = Chain(read_recording(DEMO), 0, seed=3, novelty_deg=2.0)
    looks = list(chain.looks(6, 1))
    assert {look.revision for look in looks} == {0, 1}, chain.ended
    later = [look for look in looks if look.revision == 1]
    assert all(look.fix is not None and nees_of(look) < 50.0 for look in later)


def look(revision: int, error: float, sigma: float) -> Look:
    """A pose that is off by so much along each of six axes."""
    true = Pose.identity()
    nothing = np.zeros((6, 6))
    fix = Localized(
        true.retracted(np.full(6, error)), sigma**2 * np.eye(6), nothing, np.zeros((6, 0)),
        np.zeros((0, 0)), 9, 9, True, 0.1,
    )  # fmt: skip
    return Look(0, revision, true, fix)


def test_what_is_told_of_poses() -> None:
    """Six errors of one sigma are a NEES of six; a frame that is lost counts as such."""
    sure, careful = look(0, 1e-3, 1e-3), look(1, 1e-3, 1e-2)
    assert nees_of(sure) == pytest.approx(6.0, rel=1e-3)
    wrong = look(1, 5e-3, 1e-3)
    lost = replace(sure, fix=None)
    report = recording_report(
        [Beginning(0, (sure, careful, lost), ""), Beginning(7, (wrong,), "too little")]
    )
    assert report["poses"] == 3
    assert report["lost"] == 1
    assert report["nees_median"] == pytest.approx(6.0, rel=1e-3)
    assert report["nees_median_first_map"] == pytest.approx(6.0, rel=1e-3)
    assert report["nees_median_later"] == pytest.approx(0.5 * (0.06 + 150.0), rel=1e-3)
    assert report["far_share"] == pytest.approx(1 / 3, abs=1e-5)
    assert report["within_3_sigma_share"] == pytest.approx(2 / 3, abs=1e-5)
    assert report["ended"] == {"7": "too little"}
    assert report["own_frames"]["position_error_m_most"] is None
    nothing = recording_report([Beginning(0, (lost,), "no map", (sure, wrong, lost))])
    alone = nothing["own_frames"]
    assert (alone["poses"], alone["lost"]) == (2, 1)
    assert alone["nees_median"] == pytest.approx(78.0, rel=1e-3)
    assert alone["within_3_sigma_share"] == 0.5
    assert alone["position_error_m_most"] == pytest.approx(5e-3 * 3**0.5, rel=1e-2)
    assert nothing["nees_median"] is None
    assert nothing["lost"] == 1


def run(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(main, ["consistency", *map(str, arguments)])
    return result.exit_code, result.output


def test_what_cannot_be_used_is_said_in_a_line(tmp_path: Path) -> None:
    status, text = run(tmp_path / "nowhere", "--out", tmp_path)
    assert status == 2
    assert "nowhere" in text
    status, text = run(DEMO, DEMO, "--out", tmp_path)
    assert status == 2
    assert "two recordings of one name" in text
    file = tmp_path / "file"
    file.write_text("")
    status, text = run(DEMO, "--out", file)
    assert status == 2
    assert "is a file; give a folder" in text
    untold = tmp_path / "untold"
    shutil.copytree(DEMO, untold)
    shutil.rmtree(untold / "mav1" / "state_groundtruth_estimate0")
    status, text = run(untold, "--out", tmp_path / "out")
    assert status == 2
    assert "mav1 has no ground truth" in text
    shutil.copytree(DEMO / "mav1", untold / "mav1", dirs_exist_ok=True)
    (untold / "recording.toml").write_text("frame_rate_hz = 5.0\n", encoding="utf-8")
    status, text = run(untold, "--out", tmp_path / "out")
    assert status == 2
    assert "known_distance" in text


def test_who_is_to_go_on_alone_for_longer_than_there_are_frames_does_so_to_the_last() -> None:
    chain = Chain(read_recording(DEMO), 0, seed=3, novelty_deg=5.0)
    assert list(chain.alone(3.0)) == []  # there is no map
    for _ in chain.looks(8, 0):
        pass
    # Twelve seconds at 5 Hz; by the first four it is got ready. The third one hovers until then.
    alone = list(chain.alone(600.0))
    assert [look.drone for look in alone] == [i for i in range(2) for _ in range(len(alone) // 2)]
    assert 35 <= len(alone) // 2 <= 41
    assert sum(look.fix is None for look in alone) <= len(alone) // 5


def test_a_drone_is_left_out_where_it_has_no_frame_or_no_truth() -> None:
    whole = read_recording(DEMO)
    one, two, three = whole.drones
    assert three.truth is not None
    n = 121  # six seconds of twelve
    ends = Trajectory(
        three.truth.at_ns[:n], three.truth.positions_m[:n], three.truth.quaternions[:n]
    )
    few = replace(two, frames=two.frames[:30])
    recording = replace(whole, drones=(one, few, replace(three, truth=ends)))
    seen = [look.drone for look in Chain(recording, 26, seed=3, novelty_deg=5.0).looks(2, 0)]
    assert seen[:5] == [0, 1, 2, 0, 2]
    assert set(seen[5:]) == {0}
    blind = replace(whole, drones=(replace(one, truth=ends), two, three))
    chain = Chain(blind, 50, seed=3, novelty_deg=5.0)
    assert list(chain.looks(2, 0)) == []
    assert "no truth of the leader's" in chain.ended
