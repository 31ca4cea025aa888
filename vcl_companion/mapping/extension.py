"""A map extended by views whose place on it is known already, all by patches (IV-G, issue 4).

Old landmarks are found in the new views by their patches, new ones across the
new views and the keyframes that show best what is new in them, one drone's own
earlier ones among these; then old and new are adjusted together, measured again from the
adjusted poses, and adjusted a last time. What the old keyframes show of old landmarks is taken
where the old map's estimate puts it (``settling``).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.apart import ambiguous
from vcl_companion.mapping.culling import Mask, depth_errors, fitting, of_observations, placed
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.growth import Growth, keyframe_of
from vcl_companion.mapping.known_features import Index
from vcl_companion.mapping.landmark_map import Keyframe, LandmarkMap
from vcl_companion.mapping.new_landmarks import (
    Shown,
    depth_range,
    free_of,
    new_landmarks,
    shown,
    with_room,
)
from vcl_companion.mapping.options import MapOptions
from vcl_companion.mapping.partners import partners
from vcl_companion.mapping.patch_table import (
    EXACTLY,
    PatchTable,
    PyramidOf,
    Reference,
    landmark_noise,
    pyramids_of,
)
from vcl_companion.mapping.placing import Placed, place, references
from vcl_companion.mapping.registration import MIN_SEEN
from vcl_companion.mapping.settling import believed_noise_px, noise_of, settled
from vcl_companion.mapping.sharpening import SETTLED_CAUCHY_PX
from vcl_companion.mapping.surroundings import adjusted_near
from vcl_companion.mapping.thinning import spread
from vcl_companion.mapping.told_pixels import agreed
from vcl_companion.mapping.tracks import ideal_of_pixels, slopes_of_ideal
from vcl_companion.mapping.uncertainty import MapUncertainty, distances_of, views_of
from vcl_companion.vision.bundle import BundleOptions, Views
from vcl_companion.vision.features import Detector, Features
from vcl_companion.vision.resection import NotFound

ImageFeatures = Callable[[bytes, Camera, Detector], Features]

# Old keyframes that a new view is matched with, besides all other new views.
_PARTNERS = 3
_RELATIVE_SIGMA = 0.02
_STEPS, _LEAST_GAIN = (8, 12), (1e-3, 1e-4)
# Residuals of patches that are the same spot: first loosely, by poses not adjusted yet.
_LIMIT_PX, _CAUCHY_PX = (1.5, 0.5), (0.5, SETTLED_CAUCHY_PX)
_MAX_SIGMAS = 4.0


@dataclass(frozen=True, eq=False)
class Table:
    """All landmarks in all views, while they are worked on.

    Attributes:
        observed: (N, V, 2) px.
        points: (N, 3) m, NaN where not placed.
        source: (N,) view that a new landmark's patch is cut from, -1 for old ones.
        bodies: V poses.
        noise: (N, 3) xx xy yy of each landmark's pixels (``landmark_noise``); NaN where it
            has not been looked for from poses that are adjusted already.
    """

    observed: Array
    points: Array
    source: Index
    bodies: tuple[Pose, ...]
    noise: Array


class Extension:
    """One extension under way.

    Args:
        old: the map so far.
        sure: its uncertainty.
        views: new ones, with a guess of where they were taken.
        features_of: finds features in an encoded image.
        pyramid_of: decodes one.
        options: thresholds.
    """

    def __init__(
        self,
        old: LandmarkMap,
        sure: MapUncertainty,
        views: list[DroneView],
        features_of: ImageFeatures,
        pyramid_of: PyramidOf,
        options: MapOptions,
    ) -> None:
        self._old, self._sure, self._views, self._options = old, sure, views, options
        self._features_of = features_of
        self._n_keys = len(old.keyframes)
        shown_by: list[Keyframe | DroneView] = [*old.keyframes, *views]
        self._cameras = [v.camera for v in shown_by]
        self._images = [(v.image_bytes, v.camera) for v in shown_by]
        self._mountings = tuple(v.body_from_cam for v in shown_by)
        self._table = PatchTable(self._cameras, pyramids_of(self._images, pyramid_of))
        known = views_of(old)
        self._relative = depth_errors(known)
        self._settled = settled(known, believed_noise_px(old, options))
        self.reasons: dict[int, str] = {}

    def run(self) -> Growth | None:
        """Return the grown map; None where no view has its place on it."""
        keys = [k.world_from_body @ k.body_from_cam for k in self._old.keyframes]
        joined: dict[int, Placed] = {}
        for i, view in enumerate(self._views):
            if view.world_from_body is None:
                continue
            found = place(
                view,
                self._n_keys + i,
                view.world_from_body,
                self._old,
                self._sure,
                self._relative,
                self._table,
                keys,
                self._options,
            )
            if isinstance(found, NotFound):
                self.reasons[i] = found.reason
            else:
                joined[i] = found
        if not joined:
            return None
        table = self._with_new(self._start(joined), sorted(joined))
        table, good, _ = self._adjusted(table, 0)
        table, good = self._less_ambiguous(table, good)
        table = self._measured_again(table, good, sorted(joined))
        table, good, noise_px = self._adjusted(table, 1)
        if unsupported := self._unsupported(table, good, sorted(joined)):
            joined = {i: at for i, at in joined.items() if i not in unsupported}
            if not joined:
                return None
            observed = table.observed.copy()
            observed[:, [self._n_keys + i for i in unsupported]] = np.nan
            table, good, noise_px = self._adjusted(replace(table, observed=observed), 1)
        return self._growth(table, good, noise_px, sorted(joined))

    def _unsupported(self, table: Table, good: Mask, joined: list[int]) -> list[int]:
        """Return who sees too little in the end, looked at more closely than when it joined."""
        unsupported = []
        for i in joined:
            n_seen = int(np.isfinite(table.observed[good, self._n_keys + i, 0]).sum())
            if n_seen < MIN_SEEN:
                self.reasons[i] = f"{n_seen} patches are found again, {MIN_SEEN} needed"
                unsupported.append(i)
        return unsupported

    def _start(self, joined: dict[int, Placed]) -> Table:
        """Return the old landmarks in the old keyframes and in the views that joined."""
        n, v = len(self._old.points_world), len(self._cameras)
        observed = np.full((n, v, 2), np.nan)
        observed[:, : self._n_keys] = self._old.observed_px
        bodies = [k.world_from_body for k in self._old.keyframes]
        for i, view in enumerate(self._views):
            at = joined.get(i)
            # A view that has not joined sees nothing; where it is does not matter.
            bodies.append(at.world_from_body if at else view.world_from_body or Pose.identity())
            if at:
                observed[at.landmarks, self._n_keys + i] = at.pixels
        source, noise = np.full(n, -1, np.intp), np.full((n, 3), np.nan)
        return Table(observed, self._old.points_world, source, tuple(bodies), noise)

    def _with_new(self, table: Table, joined: list[int]) -> Table:
        """Add landmarks that new views show and the map has not."""
        cams = self._cams(table)
        columns = [self._n_keys + i for i in joined]
        views = self._free(table, columns)
        partners_of = {c: self._partners(table, c, views[c], cams) for c in views}
        views |= self._free(table, sorted({k for some in partners_of.values() for k in some}))
        per_cell = self._options.landmarks_per_cell
        for c, keyframes in partners_of.items():
            others = [t for t in [*columns, *keyframes] if t != c and t in views]
            if not others:
                continue
            shown_by = dict(views)
            taken_px = _seen_px(table.observed, c)
            shown_by[c] = with_room(views[c], taken_px, self._cameras[c], per_cell)
            known = table.points[np.isfinite(table.observed[:, c, 0])]
            known = known[np.isfinite(known[:, 0])]
            inverse_depths = depth_range(cams[c].inverse(), known)
            observed, points = new_landmarks(
                c, others, shown_by, self._cameras, cams, inverse_depths, self._table
            )
            kept = spread(observed[:, [c]], [self._cameras[c]], per_cell)
            observed, points = observed[kept], points[kept]
            table = replace(
                table,
                observed=np.concatenate([table.observed, observed]),
                points=np.concatenate([table.points, points]),
                source=np.concatenate([table.source, np.full(len(points), c)]),
                noise=np.concatenate([table.noise, np.full((len(points), 3), np.nan)]),
            )
            views = {t: free_of(view, _seen_px(observed, t)) for t, view in views.items()}
        return table

    def _free(self, table: Table, columns: list[int]) -> dict[int, Shown]:
        """Return the features of views that are no landmarks yet, where an image can be read."""
        views: dict[int, Shown] = {}
        for c in columns:
            try:
                features = self._features_of(*self._images[c], self._options.detectors[0])
            except ValueError:
                continue
            views[c] = free_of(shown(features, self._cameras[c]), _seen_px(table.observed, c))
        return views

    def _partners(self, table: Table, c: int, view: Shown, cams: list[Pose]) -> list[int]:
        """Return the old keyframes that show best what is new in a view."""
        seen = np.isfinite(table.observed[:, c, 0])
        known = table.observed[seen, c], table.points[seen]
        return partners(view, *known, cams[c], cams[: self._n_keys], self._cameras, _PARTNERS)

    def _adjusted(self, table: Table, turn: int) -> tuple[Table, Mask, float]:
        """Place, drop what misses, adjust what is left, drop again."""
        ideal = ideal_of_pixels(table.observed, self._cameras)
        views = Views(
            bodies=table.bodies,
            mountings=self._mountings,
            slopes=slopes_of_ideal(ideal, self._cameras),
            ideal=ideal,
            points=table.points,
            distances=distances_of(self._old.distances),
        )
        if turn == 0:
            fresh = table.source >= 0
            points = table.points.copy()
            points[fresh] = placed(self._cams(table), ideal[fresh])
            views = replace(views, points=points)
        limit_px = max(_LIMIT_PX[turn], _MAX_SIGMAS * self._old.pixel_noise_px)
        fits, good = fitting(views, 2.0 * limit_px, self._options)
        adjusted = adjusted_near(
            of_observations(replace(views, ideal=self._with_settled(ideal)), fits),
            table.noise,
            good,
            self._n_keys,
            BundleOptions(_STEPS[turn], _CAUCHY_PX[turn], _LEAST_GAIN[turn]),
        )
        # What fits is judged by what was seen, not by where the map had put it.
        views = of_observations(replace(adjusted, ideal=ideal), fits)
        noise_px = noise_of(views, good)
        fits, again = fitting(views, max(_LIMIT_PX[turn], _MAX_SIGMAS * noise_px), self._options)
        observed = np.where(fits[..., None], table.observed, np.nan)
        return (
            replace(table, observed=observed, points=views.points, bodies=views.bodies),
            good & again,
            noise_px,
        )

    def _with_settled(self, ideal: Array) -> Array:
        """Return what is seen, old landmarks in old keyframes where the old map puts them."""
        out, n_old = ideal.copy(), len(self._settled)
        own = np.isfinite(self._settled)
        out[:n_old, : self._n_keys][own] = self._settled[own]
        return out

    def _less_ambiguous(self, table: Table, good: Mask) -> tuple[Table, Mask]:
        """Leave out new landmarks that may as well lie where what is beside them does."""
        rows = np.flatnonzero(good)
        found_beside = ambiguous(
            self._table, table.points[rows], table.observed[rows], table.source[rows],
            self._cameras, self._cams(table), EXACTLY,
        )  # fmt: skip
        some = rows[found_beside.any(axis=1)]
        observed, good = table.observed.copy(), good.copy()
        observed[some], good[some] = np.nan, False
        return replace(table, observed=observed), good

    def _measured_again(self, table: Table, good: Mask, joined: list[int]) -> Table:
        """Look for patches again from adjusted poses: old ones in new views, new ones in all."""
        cams = self._cams(table)
        observed, noise = table.observed.copy(), table.noise.copy()
        old = np.flatnonzero(good & (table.source < 0))
        known = replace(
            self._old,
            keyframes=tuple(
                replace(k, world_from_body=body)
                for k, body in zip(self._old.keyframes, table.bodies, strict=False)
            ),
            points_world=table.points[old],
            observed_px=table.observed[old, : self._n_keys],
        )
        columns = [self._n_keys + i for i in joined]
        by_view = np.full((len(old), len(columns), 3), np.nan)
        for at, c in enumerate(columns):
            which, reference = references(
                known, self._cameras[c], cams[c], self._relative[old], len(old)
            )
            found = self._table.found(reference, cams, [c], EXACTLY)
            observed[old, c] = np.nan
            observed[old[which], c] = agreed(
                found.pixels[:, c], self._views[joined[at]].told_px, old[which]
            )
            by_view[which, at] = found.noise[:, c]
        noise[old] = landmark_noise(by_view)
        fresh = np.flatnonzero(good & (table.source >= 0))
        view = table.source[fresh]
        kept = np.isfinite(table.observed[fresh, view, 0])
        fresh, view = fresh[kept], view[kept]
        if len(fresh):
            reference = Reference(
                view,
                table.observed[fresh, view],
                table.points[fresh],
                np.full(len(fresh), _RELATIVE_SIGMA),
            )
            found = self._table.found(reference, cams, [*range(self._n_keys), *columns], EXACTLY)
            observed[fresh], noise[fresh] = found.pixels, landmark_noise(found.noise)
        return replace(table, observed=observed, noise=noise)

    def _growth(self, table: Table, good: Mask, noise_px: float, joined: list[int]) -> Growth:
        columns = [*range(self._n_keys), *(self._n_keys + i for i in joined)]
        keyframes = tuple(
            replace(k, world_from_body=body)
            for k, body in zip(self._old.keyframes, table.bodies, strict=False)
        ) + tuple(keyframe_of(self._views[i], table.bodies[self._n_keys + i]) for i in joined)
        n_old = len(self._old.points_world)
        number = np.arange(len(good))
        return Growth(
            replace(
                self._old,
                keyframes=keyframes,
                points_world=table.points[good],
                observed_px=table.observed[good][:, columns],
                pixel_noise_px=noise_px,
                detectors=tuple(dict.fromkeys(self._old.detectors + self._options.detectors)),
            ),
            tuple(joined),
            np.where(number < n_old, number, -1)[good],
            {},
        )

    def _cams(self, table: Table) -> list[Pose]:
        return [b @ m for b, m in zip(table.bodies, self._mountings, strict=True)]


def _seen_px(observed: Array, column: int) -> Array:
    pixels = observed[:, column]
    return np.asarray(pixels[np.isfinite(pixels[:, 0])])
