"""The frame that the autopilot is told poses in: the world's origin, the world's north or its own.

World's north is that of the leader's autopilot at the first map. An autopilot that takes its
heading from us turns to it. One that flies by its compass keeps its own, and takes what it is told
along the axes of another for motion that its inertial sensors do not feel: it has to be told
positions turned to its north.
"""

from __future__ import annotations

import logging
import math

import numpy as np

from vcl_companion.daemon.map_store import StoredMap
from vcl_companion.geometry.rotation import Array, about_down, heading_of
from vcl_companion.geometry.similarity import Similarity
from vcl_companion.links.autopilot_options import Heading
from vcl_companion.localization.filter_state import FilterState
from vcl_companion.swarm.group import Group

_log = logging.getLogger(__name__)


class LocalFrame:
    """Where that frame is in the map's world; both have one origin until a world is left.

    Args:
        heading: whose north it has: ``map``, the world's, or ``autopilot``, the autopilot's own
            as it is when the first pose is told.
    """

    def __init__(self, heading: Heading) -> None:
        self._heading = heading
        self.from_world = Similarity.identity()
        """local_from_world, once it is settled."""
        self.is_settled = heading == "map"

    @property
    def origin_world(self) -> Array | None:
        """(3,) its origin in the world, m; None until it is settled."""
        return self.from_world.inverse().translation if self.is_settled else None

    def settles(self, state: FilterState) -> bool:
        """Whether poses can be told: with the autopilot's own north not before it has told it."""
        if not self.is_settled and state.ned_from_body is not None:
            north_rad = heading_of(state.world_from_ned.T)
            self.from_world = Similarity(about_down(north_rad), np.zeros(3))
            self.is_settled = True
            _log.info(
                "the map's north is at %.1f degrees by the autopilot", math.degrees(north_rad)
            )
        return self.is_settled

    def carry(self, other_from_world: Similarity) -> None:
        """Stay where it is while the world becomes another.

        Its metres stay what they were, too: an autopilot that is told others on its way takes that
        for motion, and a map of another scale, wrong or sent by one that lies, would have it fly
        as many times as far.
        """
        if self.is_settled:
            self.from_world = self.from_world @ other_from_world.inverse()

    def leave(self) -> None:
        """Begin anew in another world, at its origin."""
        self.from_world = Similarity.identity()
        self.is_settled = self._heading == "map"


def origin_in_leaders_world(
    local: LocalFrame, group: Group, stored: StoredMap | None
) -> Array | None:
    """Return where the origin of the autopilot's frame is in the world of the leader, (3,) m.

    Only of that world is it said where on Earth it is. A drone that flies in another one, a team's
    of its own, does not know, nor does one that has not heard from the leader what it flies in.
    Before there is a map it is the origin of the world to come: an autopilot wants its own before
    it lets itself be armed.
    """
    if stored is None:
        return np.zeros(3)
    if group.leader != group.own_id:
        leads = group.state_of(group.leader)
        if leads is None or leads.world != stored.world:
            return None
    return local.origin_world
