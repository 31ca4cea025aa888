"""Where one drone is, by the map's patches near where they are expected (issue 4; IV-D, IV-F)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose, adjoint
from vcl_companion.geometry.rotation import Array
from vcl_companion.localization.coverage import covered_share
from vcl_companion.localization.fix import Localized, NotLocalized, Prior, believed
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.patch_pose import PatchPoses
from vcl_companion.mapping.lens_errors import lens_px
from vcl_companion.mapping.novelty import novelty_deg
from vcl_companion.mapping.templates import Templates
from vcl_companion.options import require_positive
from vcl_companion.vision.features import Image
from vcl_companion.vision.information import covariance_of
from vcl_companion.vision.patch_choice import ChoiceRules, choose_anchors
from vcl_companion.vision.patch_tables import Anchors, Lens, lens_of, pyramid_of
from vcl_companion.vision.patches import Alignment, AlignRules, align_patches
from vcl_companion.vision.pose_errors import gained

_MAX_LEVERAGE = 0.4
_ROBUST_LOSS = 1.1136
_SINGULAR = 1e-9
_MAX_ROUNDS = 3
# Patches warped and begun so near to where they are need no second look.
_WELL_PREDICTED_PX = 0.5
# Of the largest radius: what is looked for there leaves some for how the drone may be turned.
_NEARER = 0.9
# A prediction that is off by so many widths of the image is none; of one that is off by more than
# the largest radius this share of the patches has to be found.
_FARTHEST, _MOST_OF_THEM = 4.0, 0.5
# Patches that lie so far from where they are in their keyframes are shifted as much as any;
# half as far, half as much.
_SHIFTED_WHOLLY_PX = 40.0


@dataclass(frozen=True)
class TrackingOptions:
    """How many patches are tracked, and when the pose is believed.

    Attributes:
        n_landmarks: patches aligned at full resolution.
        n_coarse: of these, how many find the way when the prediction is poor.
        max_radius_px: no patch is looked for farther than this, 3 sigma, from where it is expected;
            of a vaguer prediction most of them have to be there.
        least_score: correlation of an aligned patch, at least.
        coarse_score: the same at reduced resolution.
        grey_noise: of an image, grey levels, 1 sigma.
        misplaced_px: what an alignment is off whatever the view, the same in every frame.
        misplaced_px_per_deg: per angle between the lines of sight of frame and keyframe.
        misplaced_px_per_octave: per doubling or halving of the distance.
        misplaced_by_residual: per sigma that the residual of the grey levels explains.
        shifted_px: what all alignments of an image are off together, in each direction: no lens
            is known better, nor what a patch's surface, its light and an encoder do to it. However
            many landmarks there are, this does not average out. Where most patches lie nearly
            where the same drone's camera saw them in its keyframes, all that is alike, and it is
            less.
        mounted_m: how well it is known where the camera sits on its drone, per axis: no position
            is told better, however near the map's first keyframes.
    """

    n_landmarks: int = 400
    n_coarse: int = 120
    max_radius_px: float = 80.0
    least_score: float = 0.75
    coarse_score: float = 0.65
    grey_noise: float = 4.0
    misplaced_px: float = 0.04
    misplaced_px_per_deg: float = 0.009
    misplaced_px_per_octave: float = 0.03
    misplaced_by_residual: float = 0.7
    shifted_px: float = 0.03
    mounted_m: float = 0.0006

    def __post_init__(self) -> None:
        if not 20 <= self.n_coarse <= self.n_landmarks:
            raise ValueError(
                f"n_coarse must lie in 20..n_landmarks, got {self.n_coarse} of {self.n_landmarks}"
            )
        for name in ("least_score", "coarse_score"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ValueError(f"{name} must lie in (0, 1), got {getattr(self, name)}")
        require_positive(
            self,
            "max_radius_px",
            "grey_noise",
            "misplaced_px",
            "misplaced_px_per_deg",
            "misplaced_px_per_octave",
            "misplaced_by_residual",
            "shifted_px",
            "mounted_m",
        )

    def choice(self) -> ChoiceRules:
        """Return what an alignment is worth."""
        return ChoiceRules(
            40.0,
            self.grey_noise,
            self.misplaced_px,
            float(np.rad2deg(self.misplaced_px_per_deg)),
            self.misplaced_px_per_octave,
            1.5,
            3.5,
        )


def track(
    image: Image,
    camera: Camera,
    body_from_cam: Pose,
    templates: Templates,
    prior: Prior,
    ned_from_body: Array | None,
    options: TrackingOptions,
    belief: LocalizationOptions,
    drone_id: int | None = None,
) -> Localized | NotLocalized:
    """Find the drone's pose by the map's patches near where the prediction puts them.

    A poor prediction is first improved at reduced resolution; then the
    landmarks that fix the pose best are aligned at full resolution.

    Args:
        image: (H, W) grey.
        camera: its intrinsics.
        body_from_cam: its mounting.
        templates: the current map, prepared.
        prior: where the drone is expected.
        ned_from_body: (3, 3) attitude by the autopilot at that instant, or None.
        options: how it is tracked.
        belief: when a pose is believed, whatever it rests on.
        drone_id: whose camera it is, to be known among those of the keyframes; None: nobody's.

    Returns:
        The pose with its covariance in parts, or why there is none.
    """
    tracker = _Tracker(image, camera, body_from_cam, templates, options, belief, drone_id)
    return tracker.located(prior, ned_from_body)


def _radius_of(radii: Array) -> float:
    """Return how far landmarks may be from where they are expected: three quarters are nearer."""
    at = (3 * len(radii)) // 4
    return float(np.partition(radii, at)[at]) if len(radii) else 0.0


class _Tracker:
    """One image against one map."""

    def __init__(
        self,
        image: Image,
        camera: Camera,
        body_from_cam: Pose,
        templates: Templates,
        options: TrackingOptions,
        belief: LocalizationOptions,
        drone_id: int | None,
    ) -> None:
        self._frame = pyramid_of(image)
        self._camera = camera
        self._lens: Lens = lens_of(camera)
        self._mounting = body_from_cam
        self._templates = templates
        self._anchors: Anchors = templates.anchors
        self._options = options
        self._belief = belief
        self._drone_id = drone_id
        size_px = (camera.width_px, camera.height_px)
        self._poses = PatchPoses(body_from_cam, size_px, belief.min_inliers)

    def located(self, prior: Prior, ned_from_body: Array | None) -> Localized | NotLocalized:
        options = self._options
        pose = prior.world_from_body
        rows, radii, in_view = self._choose(prior)
        radius = _radius_of(radii)
        is_vague = options.max_radius_px < radius <= _FARTHEST * self._camera.width_px
        if is_vague:
            # Hardly anybody flies as fast as one may: what is near is looked at.
            slower = np.diag([_NEARER * options.max_radius_px / radius] * 3 + [1.0] * 3)
            prior = Prior(pose, slower @ prior.covariance @ slower)
            rows, radii, in_view = self._choose(prior)
            radius = _radius_of(radii)
        if len(rows) < self._belief.min_inliers:
            return NotLocalized(f"{len(rows)} landmarks in view, {self._belief.min_inliers} needed")
        if radius > options.max_radius_px:
            return NotLocalized(f"the prediction is {radius:.0f} px uncertain")
        if radius > 1.5:
            coarse = self._coarse(
                rows[: options.n_coarse], radii[: options.n_coarse], prior, radius
            )
            if isinstance(coarse, NotLocalized):
                return coarse
            pose = coarse
        found = self._aligned(rows, pose, np.zeros(len(rows)), 0, options.least_score)
        rivals = self._poses.rivals(found, pose)
        if isinstance(rivals, NotLocalized):
            return rivals
        refined = rivals[0]
        if len(rivals) > 1:
            # Found from where the wrong one is, patches are missing that are right for another.
            looks = [
                self._aligned(rows, rival, np.zeros(len(rows)), 0, options.least_score)
                for rival in rivals
            ]
            numbers = [self._poses.n_agreeing(*one) for one in zip(looks, rivals, strict=True)]
            best = int(np.argmax(numbers))
            found, refined = looks[best], rivals[best]
        elif self._is_ill_predicted(found):
            found = self._aligned(rows, refined, np.zeros(len(rows)), 0, options.least_score)
        fix = self._judged(found, refined, len(rows), in_view, ned_from_body)
        if is_vague and isinstance(fix, Localized):
            n, n_tried = fix.n_inliers, fix.n_matched
            if n < _MOST_OF_THEM * n_tried:
                why = f"{n} of {n_tried} patches agree on a pose, of a prediction that is vague"
                return NotLocalized(why, n_tried, n)
        return fix

    @staticmethod
    def _is_ill_predicted(found: Alignment) -> bool:
        """Whether half of the patches were farther than hoped from where they were expected."""
        moved = np.abs(found.pixels - found.predicted)
        return bool(2 * np.count_nonzero(moved > _WELL_PREDICTED_PX) > moved.size)

    def _choose(self, prior: Prior) -> tuple[NDArray[np.int64], Array, int]:
        return choose_anchors(
            self._anchors,
            self._lens,
            prior.world_from_body,
            self._mounting,
            prior.covariance,
            self._options.choice(),
            self._options.n_landmarks,
            6.0,
        )

    def _coarse(
        self, rows: NDArray[np.int64], radii: Array, prior: Prior, radius: float
    ) -> Pose | NotLocalized:
        """Improve a prediction at half or quarter resolution."""
        options = self._options
        level = 1 if radius <= 8.0 else 2 if radius <= 24.0 else 3
        level = min(level, len(self._frame.shelves) - 1)
        pose = prior.world_from_body
        reach = np.clip(radii, 2.0**level, options.max_radius_px)
        found = self._aligned(rows, pose, reach, level, options.coarse_score)
        return self._poses.led(found, pose, prior)

    def _aligned(
        self, rows: NDArray[np.int64], pose: Pose, radii: Array, level: int, score: float
    ) -> Alignment:
        """Return the patches that were found."""
        options = self._options
        found = align_patches(
            self._anchors,
            rows,
            self._frame,
            self._lens,
            (pose @ self._mounting).inverse(),
            radii,
            level,
            AlignRules(
                least_score=score,
                misplaced_px=options.misplaced_px,
                misplaced_px_per_rad=float(np.rad2deg(options.misplaced_px_per_deg)),
                misplaced_px_per_octave=options.misplaced_px_per_octave,
                misplaced_by_residual=options.misplaced_by_residual,
                forgives_noise=True,
            ),
        )
        return found.of(found.found)

    def _judged(
        self,
        found: Alignment,
        pose: Pose,
        n_tried: int,
        in_view: int,
        ned_from_body: Array | None,
    ) -> Localized | NotLocalized:
        """Refine a last time, and say how certain the pose is."""
        uncertainty = self._templates.uncertainty
        for _ in range(_MAX_ROUNDS):
            refined = self._poses.settled(found, pose)
            if isinstance(refined, NotLocalized):
                return refined
            pose = refined
            support = self._poses.support(found, pose)
            agrees, normal, j_poses, j_points, roots, weights, squared_px = support
            n = int(agrees.sum())
            if n < self._belief.min_inliers:
                least = self._belief.min_inliers
                return NotLocalized(f"{n} landmarks agree on a pose, {least} needed", n_tried, n)
            inverse = covariance_of(normal, _SINGULAR)
            if inverse is None:
                return NotLocalized("the patches found do not fix a pose", n_tried, n)
            leverage, covariances, lever = gained(
                inverse, j_poses, j_points, roots, weights, found.noise, found.misplaced,
                self._anchors.own[found.anchors], self._anchors.landmark[found.anchors],
                uncertainty.landmark_lever,
            )  # fmt: skip
            decisive = leverage > _MAX_LEVERAGE
            if not decisive.any():
                break
            found = found.of(~decisive)
        else:
            return NotLocalized("single landmarks decide the pose: the others do not fix it")
        by_noise, by_misplacement, by_landmarks = covariances
        fix = Localized(
            pose,
            _ROBUST_LOSS * by_noise,
            _ROBUST_LOSS * by_misplacement
            + by_landmarks
            + self._by_shift(found.of(agrees))
            + self._by_lens(found, inverse, j_poses, roots, weights)
            + np.diag([self._options.mounted_m**2] * 3 + [0.0] * 3),
            lever,
            uncertainty.keyframe_covariance,
            n_tried,
            n,
            True,
            float(np.sqrt(squared_px / n)),
            # Those that were not tried would fare like those that were.
            round(in_view * n / n_tried),
            covered_share(found.pixels[agrees], self._camera),
            "patches",
            self._novelty_deg(found.anchors[agrees], pose),
        )
        return believed(fix, ned_from_body, self._belief)

    def _by_shift(self, found: Alignment) -> Array:
        """Return the pose's (6, 6) covariance by a shift of the whole image: the camera, turned."""
        moved_px = np.linalg.norm(found.pixels - self._anchors.pixels[found.anchors], axis=1)
        # Another drone's lens is another one.
        moved_px[~self._is_ours(found)] = np.inf
        share = min(float(np.median(moved_px)) / _SHIFTED_WHOLLY_PX, 1.0)
        turned = adjoint(self._mounting)[:, 3:5]
        shifted_rad = share * self._options.shifted_px / self._camera.focal_px
        return np.asarray(shifted_rad**2 * turned @ turned.T)

    def _by_lens(
        self, found: Alignment, inverse: Array, j_poses: Array, roots: Array, weights: Array
    ) -> Array:
        """Return the pose's (6, 6) covariance by what the lens, and all patches alike, may be off.

        Of landmarks that the same drone's keyframes fixed the lens is off alike there: what counts
        is the difference.
        """
        uncertainty, camera = self._templates.uncertainty, self._camera
        causes = []
        if uncertainty.calibration_px:
            by_lens = lens_px(camera, found.pixels, uncertainty.calibration_px)
            own = self._is_ours(found)
            then = self._anchors.pixels[found.anchors[own]]
            by_lens[own] -= lens_px(camera, then, uncertainty.calibration_px)
            causes.append(by_lens)
        if uncertainty.alike_px:
            causes.append(lens_px(camera, found.pixels, uncertainty.alike_px))
        if not causes:
            return np.zeros((6, 6))
        off_px = np.concatenate(causes, axis=2)
        # In units of the residuals' sigmas, as ``j_poses``.
        first = off_px[:, 0] / roots[0][:, None]
        second = (off_px[:, 1] - roots[1][:, None] * first) / roots[2][:, None]
        moved = inverse @ ((j_poses[0] * weights) @ first + (j_poses[1] * weights) @ second)
        return np.asarray(moved @ moved.T)

    def _is_ours(self, found: Alignment) -> NDArray[np.bool_]:
        """Return (M,) whether patches are of keyframes that this drone's own camera took."""
        took = self._templates.drone_ids[self._anchors.keyframe[found.anchors]]
        return np.asarray(took == (-1 if self._drone_id is None else self._drone_id))

    def _novelty_deg(self, anchors: NDArray[np.int64], pose: Pose) -> float:
        centres = self._anchors.images.centres
        return novelty_deg(
            self._anchors.points_world[anchors],
            (pose @ self._mounting).translation,
            centres[self._anchors.keyframe[anchors]],
        )
