"""What ``vcl check`` says of a drone's own configuration."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from vcl_companion.config import Config, LogOptions
from vcl_companion.daemon.check_host import of_files
from vcl_companion.links.peers import PeerOptions
from vcl_companion.mapping.options import MapOptions
from vcl_companion.swarm.swarm_options import SwarmOptions


@pytest.mark.parametrize(
    ("members", "distances", "warned"),
    [((1,), (), False), ((1, 2), (), True), ((1, 2), ((1, 2, 3.0),), False)],
)
def test_a_swarm_of_which_no_distance_is_known_is_warned(
    members: tuple[int, ...], distances: tuple[tuple[int, int, float], ...], warned: bool
) -> None:
    swarm = SwarmOptions(members, known_distances=distances)
    others = tuple("127.0.0.1:9" for member in members if member != 1)
    config = Config(system_id=1, swarm=swarm, peers=PeerOptions(to=others, allow_unsigned=True))
    found = [check for check in of_files(config) if check.name == "swarm"]
    assert [check.grade for check in found] == (["warning"] if warned else [])


def test_places_that_cannot_be_written_are_found_before_the_flight(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "shut").mkdir(mode=0o500)
    config = Config(
        log=LogOptions(flight_log=str(tmp_path), status_file=str(tmp_path / "made" / "status")),
        peers=PeerOptions(timestamp_file=str(tmp_path / "file" / "signing.json")),
        map=MapOptions(directory=str(tmp_path / "shut" / "maps")),
    )
    found = {check.name: check for check in of_files(config) if "." in check.name}
    expected = {"log.flight_log": "failure", "peers.timestamp_file": "failure"}
    if os.geteuid() != 0:  # nothing is shut for root
        expected["map.directory"] = "warning"
    assert {name: check.grade for name, check in found.items()} == expected
    assert found["log.flight_log"].what == f"{tmp_path} is a folder"
    assert found["peers.timestamp_file"].what == f"{tmp_path / 'file'} is no folder"
