"""From one image to one pose: by patches where that can be had, else by features (IV-D, issue 4).

Two pipelines. The paper's looks for features in every frame and matches them
against the map. The default follows the map's patches from where the drone is
expected, or farther from there, and looks for features only when that fails: at the start,
when lost, when what the patches say is not believed. A pose found by features then leads
the patches once, so that what is sent is as good as the frame gives; one too
uncertain to be believed may still lead, if then most patches are where they should be.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.localization.fix import Localized, NotLocalized, Prior
from vcl_companion.localization.intra import localize_intra
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.map_index import MapIndex
from vcl_companion.localization.tracking import TrackingOptions, track
from vcl_companion.mapping.templates import Templates
from vcl_companion.vision.features import FeatureOptions, Image, detect

Pipeline = Literal["default", "paper"]


# Fewer than this share of the patches tried: they may be the ones that are wrong.
_DOUBTFUL = 0.4
# And so few agree on a wrong place too, where what is seen repeats: 0.08 and 0.12 did in a court of
# windows, on right places 0.38 and more. A camera that sees so little else is not to be trusted.
_CHANCE = 0.15
# Share of the patches tried that must agree when what led to them was not to be believed.
_LED_BY_A_VAGUE_POSE = 0.5
# How far a prediction may be off that has led to nothing: an autopilot whose attitude swings does
# not say so.
_SWUNG_RAD, _ASTRAY = np.deg2rad(1.5), 2.0


@dataclass(frozen=True)
class PipelineOptions:
    """What the steps of a frame are tuned by; see each of them.

    Attributes:
        drone_id: system id of whose frames they are: its keyframes were seen by the same lens.
    """

    features: FeatureOptions
    localization: LocalizationOptions
    tracking: TrackingOptions
    drone_id: int | None = None

    def by_heading(self, has_heading: bool) -> PipelineOptions:
        """Return the same where the autopilot's heading is its own; else of any heading."""
        if has_heading:
            return self
        return replace(self, localization=self.localization.of_any_heading())


@dataclass(frozen=True, kw_only=True)
class Effort:
    """What may be tried that takes as long as several frames.

    Attributes:
        may_track: whether patches are followed from the prediction; else features alone are
            asked, as when patches gave no pose a moment ago.
        may_search: whether features are looked for when patches alone give no pose.
        may_doubt: whether features are asked about a pose that few patches agree on.
        may_fall_back: whether a second detector is asked when the first one fails.
        has_heading: whether the attitude's heading is the autopilot's own, so by the map's north
            but for a few degrees; else a pose may have any.
    """

    may_track: bool = True
    may_search: bool = True
    may_doubt: bool = True
    may_fall_back: bool = True
    has_heading: bool = True


ALL_EFFORT = Effort()


def localize(
    image: Image,
    camera: Camera,
    body_from_cam: Pose,
    index: MapIndex,
    templates: Templates | None,
    prior: Prior | None,
    ned_from_body: Array | None,
    options: PipelineOptions,
    effort: Effort = ALL_EFFORT,
) -> Localized | NotLocalized:
    """Find the drone's pose in the map; one job for one thread, without a lock.

    A prediction that is wrong finds what is wrong of the map, and is confirmed by
    it. Where few patches agree, the features of the whole map may be asked whether
    there is a place that more agree on.

    Args:
        image: (H, W) grey.
        camera: its intrinsics.
        body_from_cam: its mounting.
        index: the current map, to be recognised.
        templates: the same map, to be tracked; None for the paper's pipeline.
        prior: where the drone is expected, or None.
        ned_from_body: (3, 3) attitude by the autopilot at that instant, or None.
        options: of the steps.
        effort: what there is time for.

    Returns:
        The pose with its covariance in parts, or why there is none: what the
        features said, for they were asked last.
    """
    options = options.by_heading(effort.has_heading)
    tracked: Localized | NotLocalized | None = None
    if templates is not None and prior is not None and effort.may_track:
        see = partial(follow, image, camera, body_from_cam, templates)
        tracked = see(prior, ned_from_body, options)
        if isinstance(tracked, NotLocalized):
            # Takes hardly longer; features take twenty times as long.
            farther = see(_astray(prior), ned_from_body, options)
            if isinstance(farther, Localized) and not _is_led_by_chance(farther):
                tracked = farther
        if isinstance(tracked, Localized):
            if not (effort.may_doubt and is_doubtful(tracked)):
                return tracked
            again = _recognised(
                image, camera, body_from_cam, index, templates, None, ned_from_body, options
            )
            more = isinstance(again, Localized) and again.n_inliers > tracked.n_inliers
            return again if more else tracked
    if templates is not None and not effort.may_search:
        return tracked or NotLocalized("lost, and not looked for again yet")
    found = _recognised(
        image, camera, body_from_cam, index, templates, prior, ned_from_body, options
    )
    by = index.fallback if effort.may_fall_back else None
    while by is not None and isinstance(found, NotLocalized):
        found = _recognised(
            image, camera, body_from_cam, by, templates, prior, ned_from_body, options
        )
        by = by.fallback
    return found


def follow(
    image: Image,
    camera: Camera,
    body_from_cam: Pose,
    templates: Templates,
    prior: Prior,
    ned_from_body: Array | None,
    options: PipelineOptions,
) -> Localized | NotLocalized:
    """Find the drone's pose by patches alone, near where it is expected; see ``localize``."""
    return _unless_by_chance(track(
        image, camera, body_from_cam, templates, prior, ned_from_body,
        options.tracking, options.localization, options.drone_id,
    ))  # fmt: skip


def follow_own_views(
    image: Image,
    camera: Camera,
    body_from_cam: Pose,
    templates: Templates,
    prior: Prior,
    ned_from_body: Array | None,
    options: PipelineOptions,
) -> Localized | NotLocalized:
    """Find the drone's pose by a local map of its own last frames, however vague that is.

    See ``follow``; vague up to ``LocalizationOptions.max_own_sigma_m``.
    """
    options = replace(options, localization=options.localization.of_own_views())
    found = follow(image, camera, body_from_cam, templates, prior, ned_from_body, options)
    return replace(found, by="odometry") if isinstance(found, Localized) else found


def is_doubtful(fix: Localized) -> bool:
    """Return whether few of the patches that should be seen agree on a pose."""
    return fix.by == "patches" and fix.n_inliers < _DOUBTFUL * fix.n_matched


def _unless_by_chance(fix: Localized | NotLocalized) -> Localized | NotLocalized:
    """Refuse a pose that hardly any of the patches tried agree on."""
    if isinstance(fix, NotLocalized) or not _is_by_chance(fix):
        return fix
    n, n_tried = fix.n_inliers, fix.n_matched
    return NotLocalized(f"only {n} of {n_tried} landmarks tried agree on a pose", n_tried, n)


def _is_by_chance(fix: Localized | NotLocalized) -> bool:
    """Whether patches were found, and hardly any of those tried agree."""
    return 0 < fix.n_inliers < _CHANCE * fix.n_matched


def _is_led_by_chance(fix: Localized) -> bool:
    """Whether too few agree where what led to them was not to be believed."""
    return fix.n_inliers < _LED_BY_A_VAGUE_POSE * fix.n_matched


def _astray(prior: Prior) -> Prior:
    """Return a prediction that is off by more than it says."""
    covariance = _ASTRAY**2 * prior.covariance
    covariance[3:, 3:] += _SWUNG_RAD**2 * np.eye(3)
    return Prior(prior.world_from_body, covariance)


def _recognised(
    image: Image,
    camera: Camera,
    body_from_cam: Pose,
    index: MapIndex,
    templates: Templates | None,
    prior: Prior | None,
    ned_from_body: Array | None,
    options: PipelineOptions,
) -> Localized | NotLocalized:
    """Find the pose by one detector's features, and let it lead the patches."""
    found = localize_intra(
        detect(image, index.detector, options.features),
        camera, body_from_cam, index, prior, ned_from_body, options.localization,
    )  # fmt: skip
    if isinstance(found, Localized):
        leads: Prior | None = Prior(found.world_from_body, found.covariance())
    else:
        leads = found.vague
    if templates is None or leads is None:
        return found
    closer = track(
        image, camera, body_from_cam, templates, leads, ned_from_body,
        options.tracking, options.localization, options.drone_id,
    )  # fmt: skip
    if _is_by_chance(closer):
        return _unless_by_chance(closer)
    if isinstance(closer, NotLocalized):
        return found
    if isinstance(found, NotLocalized) and _is_led_by_chance(closer):
        return found
    return closer
