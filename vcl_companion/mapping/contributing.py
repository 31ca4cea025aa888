"""Whose views extend a map that is known well where they are: of like ones two suffice (IV-G)."""

from __future__ import annotations

from collections.abc import Collection, Iterable

import numpy as np

from vcl_companion.mapping.landmark_map import LandmarkMap

# New landmarks are placed by two views, and by those that the map has already.
_N_ALIKE = 2
# Two views are alike where so much of what one shows is in the other.
_COMMON_SHARE = 0.5


def without_alike(
    drones: Iterable[int], landmark_map: LandmarkMap, needed: Collection[int]
) -> tuple[int, ...]:
    """Leave out whose newest keyframe shows what those of two others before it show.

    Args:
        drones: who could contribute a view, the most important first.
        landmark_map: what it would extend.
        needed: who is not left out, whatever its keyframe showed, and leaves out nobody: what it
            sees now is not known.
    """
    seen = landmark_map.seen
    # By their order, which is that of growth: a drone's clock begins anew when it is restarted.
    newest = {k.drone_id: column for column, k in enumerate(landmark_map.keyframes)}
    chosen: list[int] = []
    for drone in drones:
        if drone in needed or drone not in newest:
            chosen.append(drone)
            continue
        others = [newest[other] for other in chosen if other in newest and other not in needed]
        shown = seen[seen[:, newest[drone]]]
        common = np.count_nonzero(shown[:, others], axis=0)
        alike = common >= max(_COMMON_SHARE * len(shown), 1.0)
        if np.count_nonzero(alike) < _N_ALIKE:
            chosen.append(drone)
    return tuple(chosen)
