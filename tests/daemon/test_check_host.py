"""What ``vcl check`` says of a drone's own configuration."""

from __future__ import annotations

import pytest

from vcl_companion.config import Config
from vcl_companion.daemon.check_host import of_files
from vcl_companion.links.peers import PeerOptions
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
