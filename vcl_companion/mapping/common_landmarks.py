"""Landmarks that two maps may have in common, by what their keyframes show (IV-G).

Maps of one line share keyframes: what lies at the same pixel there is the same.
Others are recognised by the descriptors of their landmarks, with wrong ones among them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.known_features import Index, KeyframeLibrary
from vcl_companion.mapping.landmark_map import Keyframe, LandmarkMap
from vcl_companion.vision.features import Features
from vcl_companion.vision.matching import MatchOptions, match_mutual

# The same spot of the same image, measured twice, is found again within this.
_SAME_PX = 0.5
# Of larger maps the newest keyframes are compared: every one with every one is quadratic.
_MOST_KEYFRAMES = 24
# Where it is known what shows the same, each is compared with so many that show most of it, and
# at least so much.
_EXPECTED, _LEAST_SHARE = 3, 0.25


@dataclass(frozen=True, eq=False)
class Common:
    """Pairs of landmarks, each pair once; one landmark may be in several.

    Attributes:
        senior: (M,) landmarks of the one map.
        junior: (M,) landmarks of the other.
        certain: (M,) whether a keyframe of both shows them at the same pixel.
    """

    senior: Index
    junior: Index
    certain: NDArray[np.bool_]

    def of(self, chosen: NDArray[np.bool_] | Index) -> Common:
        """Return some of the pairs."""
        return Common(self.senior[chosen], self.junior[chosen], self.certain[chosen])


def shared_keyframes(senior: LandmarkMap, junior: LandmarkMap) -> list[tuple[int, int]]:
    """Return the places, in each map, of the images that are keyframes of both."""

    def names(landmark_map: LandmarkMap) -> list[tuple[int, int, bytes]]:
        # With the image: a clock that was started again says an instant twice.
        return [(k.drone_id, k.captured_at_ns, k.image_bytes) for k in landmark_map.keyframes]

    where = {name: i for i, name in enumerate(names(senior))}
    return [(where[name], i) for i, name in enumerate(names(junior)) if name in where]


def common_where_expected(
    senior: LandmarkMap,
    junior: LandmarkMap,
    of_senior: KeyframeLibrary,
    of_junior: KeyframeLibrary,
) -> Common:
    """Find what ``common_landmarks`` does for two maps of one world, by few pairs of keyframes.

    Their poses say which of them show the same, however far apart the two have drifted, as long
    as that is less than what an image shows.
    """
    shared = shared_keyframes(senior, junior)
    certain = [_at_same_pixels(senior, junior, k, i) for k, i in shared]
    alike = []
    for i in range(len(junior.keyframes))[-_MOST_KEYFRAMES:]:
        if any(i == of_both for _, of_both in shared):
            continue
        points = junior.points_world[junior.seen[:, i]]
        shares = np.array([_share_in_view(k, points) for k in senior.keyframes])
        for k in np.argsort(-shares, kind="stable")[:_EXPECTED]:
            if shares[k] >= _LEAST_SHARE:
                own, theirs = _landmarks_shown(of_senior, int(k)), _landmarks_shown(of_junior, i)
                alike.append(_alike(own, theirs))
    return _gathered(certain, alike)


def _share_in_view(keyframe: Keyframe, points: Array) -> float:
    """Return which share of (M, 3) points, world, a keyframe's camera sees; 0 of none."""
    cam_from_world = (keyframe.world_from_body @ keyframe.body_from_cam).inverse()
    inside = keyframe.camera.shows(keyframe.camera.project(cam_from_world.apply(points)), 0.0)
    return float(inside.mean()) if len(inside) else 0.0


def common_landmarks(
    senior: LandmarkMap,
    junior: LandmarkMap,
    of_senior: KeyframeLibrary,
    of_junior: KeyframeLibrary,
) -> Common:
    """Find pairs of landmarks that may be the same.

    Args:
        senior: the one map.
        junior: the other.
        of_senior: the features of the one's keyframes.
        of_junior: and of the other's.
    """
    shared = shared_keyframes(senior, junior)
    certain = [_at_same_pixels(senior, junior, k, i) for k, i in shared]
    newest = [np.arange(len(m.keyframes))[-_MOST_KEYFRAMES:].tolist() for m in (senior, junior)]
    here, there = {k for k, _ in shared}, {i for _, i in shared}
    one = [_landmarks_shown(of_senior, k) for k in newest[0]]
    other = [_landmarks_shown(of_junior, i) for i in newest[1] if i not in there]
    alike = [_alike(a, b) for a in one for b in other]
    # A junior's keyframe that both have is compared with those that only the senior has.
    rest = [_landmarks_shown(of_junior, i) for i in newest[1] if i in there]
    own = [shown for k, shown in zip(newest[0], one, strict=True) if k not in here]
    alike += [_alike(a, b) for a in own for b in rest]
    return _gathered(certain, alike)


def _at_same_pixels(senior: LandmarkMap, junior: LandmarkMap, k: int, i: int) -> Index:
    """Return (M, 2) landmarks that lie at the same pixel of a keyframe of both."""
    here, there = np.flatnonzero(senior.seen[:, k]), np.flatnonzero(junior.seen[:, i])
    if len(here) == 0 or len(there) == 0:
        return np.zeros((0, 2), np.intp)
    mine, theirs = senior.observed_px[here, k], junior.observed_px[there, i]
    distance, nearest = cKDTree(mine).query(theirs)
    _, back = cKDTree(theirs).query(mine)
    nearest, back = np.asarray(nearest, dtype=np.intp), np.asarray(back, dtype=np.intp)
    same = (back[nearest] == np.arange(len(there))) & (distance < _SAME_PX)
    return np.stack([here[nearest[same]], there[same]], axis=1)


def _landmarks_shown(library: KeyframeLibrary, k: int) -> tuple[tuple[Features, Index], ...]:
    """Return, for each detector, a keyframe's features that are landmarks, and which."""
    known, start, out = library.of(k), 0, []
    for features in known.features:
        owner = known.landmark[start : start + len(features)]
        index = np.flatnonzero(owner >= 0)
        out.append((features.subset(index), owner[index]))
        start += len(features)
    return tuple(out)


def _alike(a: tuple[tuple[Features, Index], ...], b: tuple[tuple[Features, Index], ...]) -> Index:
    """Return (M, 2) landmarks of two keyframes that match."""
    found = [np.zeros((0, 2), np.intp)]
    for (features_a, owner_a), (features_b, owner_b) in zip(a, b, strict=True):
        i, k = match_mutual(features_a, features_b, MatchOptions())
        found.append(np.stack([owner_a[i], owner_b[k]], axis=1))
    return np.concatenate(found)


def _gathered(certain: list[Index], alike: list[Index]) -> Common:
    none = np.zeros((0, 2), np.intp)
    sure = np.unique(np.concatenate([none, *certain]), axis=0)
    # The two landmarks that one pixel says are the same need no description.
    known = [np.isin(np.concatenate([none, *alike])[:, side], sure[:, side]) for side in (0, 1)]
    maybe = np.unique(np.concatenate([none, *alike])[~(known[0] | known[1])], axis=0)
    pairs = np.concatenate([sure, maybe])
    return Common(pairs[:, 0], pairs[:, 1], np.arange(len(pairs)) < len(sure))
