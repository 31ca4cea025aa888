"""When a map is updated, by whose frames, and how long is waited for what: the settings."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class UpdateOptions:
    """When a map is updated, and how.

    Attributes:
        tracked: a drone that sees fewer landmarks of the map wants it updated.
        share: so does one that sees less than this share of the most that it
            has seen of this revision; 0 for both of them: maps stay as they are.
        enough: of the most that was seen no more are counted: what is lost of more is no loss.
        covered: share of the image that the map has to fill with ``enough`` landmarks or fewer;
            with four times as many, half of that.
        novelty_deg: landmarks are seen from so far aside of where they are remembered, or as
            much nearer or farther (``mapping.novelty``), before the map is extended;
            1.6 times that where it is only foreseen.
        ahead_s: a map is judged by what will be seen of it when an update, begun now, is there;
            where the last one took longer, by so much, up to twice as long.
        sigma_m: positions better than this are good enough.
        sigma_growth: above that, a drone wants an update when its position is known
            so many times worse than it was at best on this revision.
        hold_s: how long the majority has to want it.
        interval_s: shortest time from the end of one round, or from a new revision,
            to the next round; up to eight times as long while rounds do not help.
        gather_timeout_s: how long a round waits for the members' frames, beyond what these
            take on the link.
        delivery_wait_s: how long a revision may take to reach everybody alive
            before the next round, and how long a peer that claims a map may take
            to deliver it before a first one is made without it.
        contributors: of how many members' frames a map is made or updated, at most.
        lost_s: a member that has not localized for so long sends several frames.
        joiner_frames: how many.
        joiner_spacing_s: time between them.
        frame_wait_s: how long a frame that the map does not know waits for the next
            revision, while no newer frame comes.
    """

    # A round takes seconds, and in fast flight landmarks halve in five: after two halvings
    # there must still be more than localization needs (15).
    tracked: int = 100
    # Beside its own keyframe a map is seen half as well again as from anywhere else, so this
    # is little less than what is usual: it has to be early, for the same reason.
    share: float = 0.6
    enough: int = 600
    covered: float = 0.7
    novelty_deg: float = 5.0
    ahead_s: float = 2.0
    sigma_m: float = 0.005
    sigma_growth: float = 1.5
    hold_s: float = 0.1
    interval_s: float = 0.5
    gather_timeout_s: float = 5.0
    delivery_wait_s: float = 30.0
    contributors: int = 8
    lost_s: float = 3.0
    joiner_frames: int = 4
    joiner_spacing_s: float = 1.5
    frame_wait_s: float = 10.0

    def __post_init__(self) -> None:
        if self.tracked < 0:
            raise ValueError(f"tracked must not be negative, got {self.tracked}")
        if self.enough < 1:
            raise ValueError(f"enough must be positive, got {self.enough}")
        if not 0 <= self.share < 1:
            raise ValueError(f"share must lie in [0, 1), got {self.share}")
        if not 0 <= self.covered < 1:
            raise ValueError(f"covered must lie in [0, 1), got {self.covered}")
        if not self.sigma_growth > 1:
            raise ValueError(f"sigma_growth must be more than 1, got {self.sigma_growth}")
        for name in (
            "novelty_deg",
            "ahead_s",
            "sigma_m",
            "hold_s",
            "interval_s",
            "gather_timeout_s",
            "delivery_wait_s",
            "lost_s",
            "joiner_spacing_s",
            "frame_wait_s",
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be positive, got {value}")
        if not 2 <= self.contributors <= 64:
            raise ValueError(f"contributors must lie in 2..64, got {self.contributors}")
        if not 1 <= self.joiner_frames <= 8:
            raise ValueError(f"joiner_frames must lie in 1..8, got {self.joiner_frames}")
