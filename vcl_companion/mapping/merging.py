"""Two maps merged in the world of the one: drones that split come together again (IV-G).

How the maps stand to each other is measured by landmarks of both (``aligning``); then the
one's keyframes and landmarks are carried over, what is the same is united, and everything is
adjusted together, held by the frame and the known distances of both. Who flies on the senior
map sees no jump: it is a revision of it like any other, compared with it like any other.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vcl_companion.geometry.rotation import Array
from vcl_companion.geometry.similarity import Similarity
from vcl_companion.mapping.agreement import contradiction
from vcl_companion.mapping.aligning import MIN_COMMON, Aligned, Side, aligned
from vcl_companion.mapping.common_landmarks import (
    common_landmarks,
    common_where_expected,
    shared_keyframes,
)
from vcl_companion.mapping.continuity import broken_continuity, pruned
from vcl_companion.mapping.culling import Mask, decisive, fitting, of_landmarks, of_observations
from vcl_companion.mapping.extension import ImageFeatures
from vcl_companion.mapping.growth import Growth
from vcl_companion.mapping.known_features import Index, KeyframeLibrary, of_keyframes
from vcl_companion.mapping.landmark_map import MAX_JOINED, JoinedMap, Keyframe, LandmarkMap
from vcl_companion.mapping.options import MOST_PIXELS, MapOptions, NoMap
from vcl_companion.mapping.patch_table import PyramidOf, decoded_pyramid
from vcl_companion.mapping.reconstruction import accepted
from vcl_companion.mapping.registration import MIN_SEEN
from vcl_companion.mapping.settling import believed_noise_px, noise_of
from vcl_companion.mapping.thinning import spread
from vcl_companion.mapping.tracks import ideal_of_pixels, slopes_of_ideal
from vcl_companion.mapping.uncertainty import MapUncertainty, distances_of, map_uncertainty
from vcl_companion.mapping.union import Union, united
from vcl_companion.vision.bundle import BundleOptions, Views, adjust
from vcl_companion.vision.features import Detector

# So many landmarks of both tell how two maps of one world stand, whatever else there is.
_PLENTY = 5 * MIN_COMMON
# A landmark that is off by more than this share of its distance may be its neighbour's like.
_SLIPPED = 0.05
# The table of all landmarks in all keyframes is as large as peers take one at most.
_MAX_CELLS = 1 << 20
# Residuals, in units of the last limit, and steps: a map may be bent before it is adjusted.
_TURNS = ((8.0, 8), (3.0, 8), (1.0, 12))
_LIMIT_PX, _MAX_SIGMAS = 0.5, 4.0
# A map made with the same options has no more keyframes than they allow; work is bounded by it.
_MOST_KEYFRAMES = 2
# A merged map's worlds lie no further apart, nor differ more in scale: the wire has bounds.
_FARTHEST_M, _MOST_SCALE = 30_000.0, 5.0


def merged(
    senior: LandmarkMap,
    senior_revision: bytes,
    junior: LandmarkMap,
    junior_revision: bytes,
    features_of: ImageFeatures,
    options: MapOptions,
    seed: int = 0,
    pyramid_of: PyramidOf = decoded_pyramid,
    sure: MapUncertainty | None = None,
) -> LandmarkMap | NoMap:
    """Make the next revision of a map from it and another one.

    Args:
        senior: the map whose world is kept.
        senior_revision: its revision.
        junior: another one, of the same world or any; it may come from anybody.
        junior_revision: its revision.
        features_of: finds features in an encoded image.
        options: thresholds; the detectors that landmarks are recognised by.
        seed: of the robust searches.
        pyramid_of: decodes an image.
        sure: how well the senior map is known, if that is known already.

    Returns:
        A map whose parent is the senior one, and which names the junior one as
        joined; or why there is none.
    """
    reason = _needless(senior, senior_revision, junior, junior_revision, options)
    if reason:
        return NoMap(reason)
    one_world = senior.world_of(senior_revision) == junior.world_of(junior_revision)
    try:
        one = Side(senior, sure or map_uncertainty(senior, options.calibration_px))
        other = _side(junior, options)
        stands = _aligned(one, other, features_of, options, seed, one_world=one_world)
        if isinstance(stands, NoMap):
            return stands
        if _is_in(senior, junior):
            return _named(senior, senior_revision, junior, junior_revision, stands)
        both = united(one, other, stands, pyramid_of, options, one_world=one_world)
        grown, number = _adjusted(both, one, other, options)
        row = np.where(both.row >= 0, number[both.row], -1)
        there = _carried(grown.landmark_map, row, other, stands)
        named = replace(
            grown.landmark_map,
            parent=senior_revision,
            world=senior.world_of(senior_revision),
            joined=_joined(senior, junior, junior_revision, there),
        )
        return _checked(replace(grown, landmark_map=named), one, options)
    except ValueError as error:
        return NoMap(str(error))


def _aligned(
    one: Side,
    other: Side,
    features_of: ImageFeatures,
    options: MapOptions,
    seed: int,
    *,
    one_world: bool,
) -> Aligned | NoMap:
    """Find how the junior map stands to the senior: in one world where it says, if that suffices.

    So it does where all its keyframes are in both.

    All keyframes with all, by all detectors, takes five times as long, and nobody's map is
    extended meanwhile.
    """

    def libraries(detectors: tuple[Detector, ...]) -> tuple[KeyframeLibrary, KeyframeLibrary]:
        found = of_keyframes(features_of, detectors)
        return KeyframeLibrary(one.map, found), KeyframeLibrary(other.map, found)

    if one_world or _is_in(one.map, other.map):
        few = common_where_expected(one.map, other.map, *libraries(options.detectors[:1]))
        stands = aligned(one, other, few, options, seed, one_world=True)
        if isinstance(stands, Aligned) and _is_as_expected(stands, one, other):
            return stands
    common = common_landmarks(one.map, other.map, *libraries(options.detectors))
    return aligned(one, other, common, options, seed, one_world=one_world)


def _is_as_expected(stands: Aligned, one: Side, other: Side) -> bool:
    """Whether maps of one world stand as they say, or the pairs that were looked at may mislead.

    They were chosen by where both maps say that they are: had one slipped, along a facade with
    windows like windows, what speaks for its true place was not looked at.
    """
    common = stands.common
    if len(common.senior) < _PLENTY:
        return False
    if common.certain.sum() >= MIN_COMMON:
        return True
    points = other.map.points_world[common.junior]
    moved = np.linalg.norm(one.map.points_world[common.senior] - points, axis=1)
    seen_by = other.map.seen[common.junior].argmax(axis=1)
    centres = np.array(
        [(k.world_from_body @ k.body_from_cam).translation for k in other.map.keyframes]
    )
    away = np.linalg.norm(points - centres[seen_by], axis=1)
    return bool(np.median(moved) < _SLIPPED * np.median(away))


def _needless(
    senior: LandmarkMap,
    senior_revision: bytes,
    junior: LandmarkMap,
    junior_revision: bytes,
    options: MapOptions,
) -> str:
    """Say why two maps need not, or must not, be looked at; empty if they are to be."""
    if senior_revision == junior_revision:
        return "a map is not merged with itself"
    most = _MOST_KEYFRAMES * options.max_keyframes
    if len(junior.keyframes) > most:
        return f"the other map has {len(junior.keyframes)} keyframes, at most {most}"
    if junior.n_pixels > MOST_PIXELS:
        return f"the other map has {junior.n_pixels} pixels, at most {MOST_PIXELS}"
    if any(j.revision == junior_revision for j in senior.joined):
        return "the other map is in this one already"
    return ""


def _is_in(senior: LandmarkMap, junior: LandmarkMap) -> bool:
    """Whether a map has no keyframe that the senior has not: merged into what that has merged."""
    return len(shared_keyframes(senior, junior)) == len(junior.keyframes)


def _named(
    senior: LandmarkMap,
    senior_revision: bytes,
    junior: LandmarkMap,
    junior_revision: bytes,
    stands: Aligned,
) -> LandmarkMap:
    """Return the senior map as it is, but that it says where a map lies whose keyframes it has.

    Who flies on that has no other way into this one.

    Raises:
        ValueError: the junior's world is too far away.
    """
    return replace(
        senior,
        parent=senior_revision,
        world=senior.world_of(senior_revision),
        joined=_joined(senior, junior, junior_revision, stands.senior_from_junior),
    )


def _side(junior: LandmarkMap, options: MapOptions) -> Side:
    try:
        return Side(junior, map_uncertainty(junior, options.calibration_px))
    except ValueError as error:
        raise ValueError(f"the other map: {error}") from None


def _adjusted(both: Union, senior: Side, junior: Side, options: MapOptions) -> tuple[Growth, Index]:
    """Adjust two maps together, drop what does not fit.

    Returns:
        The grown senior map, not named yet, and for each landmark of the union its number in
        it, -1 where it was dropped.

    Raises:
        ValueError: nothing of the junior's is left.
    """
    n_old = len(senior.map.points_world)
    rows = _with_room(both, n_old, options)
    cameras = [k.camera for k in both.keyframes]
    observed = both.observed[rows]
    ideal = ideal_of_pixels(observed, cameras)
    views = Views(
        bodies=tuple(k.world_from_body for k in both.keyframes),
        mountings=tuple(k.body_from_cam for k in both.keyframes),
        slopes=slopes_of_ideal(ideal, cameras),
        ideal=ideal,
        points=both.points[rows],
        distances=distances_of(both.distances),
    )
    settled = both.settled[rows]
    settled = np.where(np.isfinite(settled), settled, ideal)
    noise_px = _noise_px(senior, junior, options)
    views, fits, good, noise_px = _settled(views, settled, noise_px, options)
    columns = _tied(fits & good[:, None], len(senior.map.keyframes))
    observed = np.where(fits[..., None], observed, np.nan)[:, columns]
    good &= np.isfinite(observed[..., 0]).sum(axis=1) >= 2
    place = np.full(len(both.keyframes), -1, dtype=np.intp)
    place[columns] = np.arange(len(columns))
    whole = LandmarkMap(
        keyframes=tuple(
            replace(both.keyframes[c], world_from_body=views.bodies[c]) for c in columns
        ),
        points_world=views.points[good],
        observed_px=observed[good],
        pixel_noise_px=noise_px,
        detectors=tuple(dict.fromkeys(senior.map.detectors + junior.map.detectors)),
        distances=tuple(
            replace(d, keyframe_a=int(place[d.keyframe_a]), keyframe_b=int(place[d.keyframe_b]))
            for d in both.distances
            if place[d.keyframe_a] >= 0 and place[d.keyframe_b] >= 0
        ),
        parent=senior.map.parent,
        anchor_covariance=senior.map.anchor_covariance,
    )
    kept = rows[good]
    number = np.full(len(both.points), -1, dtype=np.intp)
    number[kept] = np.arange(len(kept))
    return Growth(whole, (), np.where(kept < n_old, kept, -1), {}), number


def _with_room(both: Union, n_old: int, options: MapOptions) -> Index:
    """Return the landmarks that stay: the senior's, and others that some image has room for."""
    cameras = [k.camera for k in both.keyframes]
    kept = spread(both.observed, cameras, options.landmarks_per_cell)
    # Maps of features have a crowd, which is theirs; thinned is what patches have made.
    fresh = kept[kept >= n_old] if options.patches else np.arange(n_old, len(both.points))
    most = max(_MAX_CELLS // len(both.keyframes) - n_old, 0)
    if len(fresh) > most:
        longest = np.argsort(-np.isfinite(both.observed[fresh, :, 0]).sum(axis=1), kind="stable")
        fresh = np.sort(fresh[longest[:most]])
    return np.concatenate([np.arange(n_old), fresh])


def _noise_px(senior: Side, junior: Side, options: MapOptions) -> float:
    """Return the noise that observations are judged by: the junior's word counts so far only."""
    return max(senior.map.pixel_noise_px, believed_noise_px(junior.map, options))


def _settled(
    views: Views, settled: Array, noise_px: float, options: MapOptions
) -> tuple[Views, Mask, Mask, float]:
    """Adjust with ever narrower limits; return also what fits, and the noise of that.

    Args:
        views: both maps; what fits is judged by its observations.
        settled: (N, V, 2) what is adjusted by (``union``).
        noise_px: of the observations.
        options: of the map.
    """
    limit_px = max(_LIMIT_PX, _MAX_SIGMAS * noise_px)
    good = np.ones(len(views.points), dtype=bool)
    for factor, steps in _TURNS:
        # What missed by the poses of one turn may fit by those of the next.
        fits, again = fitting(views, factor * limit_px, options)
        good &= again
        used = of_observations(replace(views, ideal=settled), fits)
        good[np.flatnonzero(good)[decisive(of_landmarks(used, good))]] = False
        cauchy_px = max(_LIMIT_PX, 3.0 * noise_px)
        adjusted, _ = adjust(of_landmarks(used, good), BundleOptions(steps, cauchy_px))
        points = views.points.copy()
        points[good] = adjusted.points
        views = replace(views, bodies=adjusted.bodies, points=points)
    fits, again = fitting(views, limit_px, options)
    good &= again
    return views, fits, good, noise_of(of_observations(views, fits), good)


def _tied(seen: Mask, n_old: int) -> Index:
    """Return the keyframes that stay: those of the senior, and others that see enough.

    Raises:
        ValueError: no other does.
    """
    enough = seen.sum(axis=0) >= MIN_SEEN
    enough[:n_old] = True
    if not enough[n_old:].any():
        raise ValueError("adjusted together with this map, no keyframe of the other one fits")
    return np.flatnonzero(enough)


def _carried(whole: LandmarkMap, row: Index, junior: Side, stands: Aligned) -> Similarity:
    """Return where the junior's world lies in the end: by where its landmarks have come to."""
    kept = np.flatnonzero(row >= 0)
    weights = 1.0 / (np.trace(junior.sure.marginal()[kept], axis1=1, axis2=2) + 1e-12)
    there = Similarity.of_points(
        junior.map.points_world[kept], whole.points_world[row[kept]], weights
    )
    return there or stands.senior_from_junior


def _joined(
    senior: LandmarkMap, junior: LandmarkMap, junior_revision: bytes, there: Similarity
) -> tuple[JoinedMap, ...]:
    """Return what the merged map says of the maps that are in it, the newest last.

    What the junior says is joined in it is not carried on: nothing here shows it, and a drone
    whose map is said to be in ours is waited for no more. It offers its map itself, and is named.

    Raises:
        ValueError: the junior's world is too far away.
    """
    own = JoinedMap(junior_revision, junior.world_of(junior_revision), there)
    if not _is_near(own):
        raise ValueError("the other map's world is too far away")
    return (*senior.joined, own)[-MAX_JOINED:]


def _is_near(joined: JoinedMap) -> bool:
    at = joined.world_from_other
    near = float(np.abs(at.translation).max()) < _FARTHEST_M
    return near and 1.0 / _MOST_SCALE < at.scale < _MOST_SCALE


def _checked(grown: Growth, senior: Side, options: MapOptions) -> LandmarkMap | NoMap:
    """Refuse what would take those along who fly on the senior map; bound the rest."""
    reason = broken_continuity(senior.map, senior.sure, grown)
    if reason:
        return NoMap(reason)
    ordered, n_old = _newest_last(grown.landmark_map, options.max_keyframes // 2)
    made = pruned(ordered, n_old, options)
    reason = contradiction(senior.map, senior.sure, made)
    if reason:
        return NoMap(f"merged, it contradicts the map in use: {reason}")
    return accepted(made, options)


def _newest_last(landmark_map: LandmarkMap, most: int) -> tuple[LandmarkMap, int]:
    """Put each drone's newest keyframe, where it flies now, behind those that may be dropped.

    Returns:
        The map in that order, the first keyframe still the first; and how many may be.
    """
    keyframes = landmark_map.keyframes
    newest = {k.drone_id: i for i, k in sorted(enumerate(keyframes), key=_instant)}
    last = sorted(set(newest.values()) - {0})[-most:]
    order = [i for i in range(len(keyframes)) if i not in last] + last
    place = {c: n for n, c in enumerate(order)}
    ordered = replace(
        landmark_map,
        keyframes=tuple(keyframes[c] for c in order),
        observed_px=landmark_map.observed_px[:, order],
        distances=tuple(
            replace(d, keyframe_a=place[d.keyframe_a], keyframe_b=place[d.keyframe_b])
            for d in landmark_map.distances
        ),
    )
    return ordered, len(order) - len(last)


def _instant(numbered: tuple[int, Keyframe]) -> int:
    return numbered[1].captured_at_ns
