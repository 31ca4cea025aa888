"""A map from a peer becomes recognisable again, or is refused: never anything else."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.checks import assert_pose_close
from tests.localization.facade import CAMERA, MOUNTING, features_from, photographed_map
from tests.scenes import perturbed, random_rotation
from vcl_companion.geometry.camera import Camera, DistortionModel
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import matrix_from_euler
from vcl_companion.localization.fix import Localized, NotLocalized, Prior
from vcl_companion.localization.intra import localize_intra
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.map_index import index_map
from vcl_companion.mapping.keyframe_image import decode_image, encode_image
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.vision.features import FeatureOptions, Features, detect
from vcl_companion.wire.map_codec import decode_map, encode_map

BODIES = (
    Pose.identity(),
    Pose(matrix_from_euler(0.02, 0.01, -0.08), np.array([0.3, 1.2, -0.1])),
)
TRUTH = Pose(matrix_from_euler(-0.02, 0.02, -0.04), np.array([0.5, 0.6, 0.1]))
PRIOR = Prior(TRUTH, np.diag([0.01] * 3 + [1e-4] * 3))
FEATURES = FeatureOptions()


@cache
def photographed() -> LandmarkMap:
    return photographed_map(BODIES)


@cache
def seen_from_truth() -> Features:
    return features_from(TRUTH)


def test_every_entry_is_the_descriptor_of_its_landmark() -> None:
    landmark_map = photographed()
    index = index_map(landmark_map, "akaze", FEATURES)
    assert index.landmark_map is landmark_map
    # Every landmark was detected in these very images, in both keyframes.
    assert len(index.owner) == landmark_map.seen.sum()
    assert set(index.owner.tolist()) == set(range(len(landmark_map.points_world)))
    n_first = int(landmark_map.seen[:, 0].sum())
    for i, rows in enumerate((slice(0, n_first), slice(n_first, None))):
        owner = index.owner[rows]
        np.testing.assert_allclose(index.entries.pixels[rows], landmark_map.observed_px[owner, i])
        keyframe = landmark_map.keyframes[i]
        image = decode_image(keyframe.image_bytes, keyframe.camera)
        again = detect(image, "akaze", FEATURES)
        known = {tuple(p): bytes(d) for p, d in zip(again.pixels, again.descriptors, strict=True)}
        for pixel, descriptor in zip(
            index.entries.pixels[rows], index.entries.descriptors[rows], strict=True
        ):
            assert known[tuple(pixel)] == bytes(descriptor)
    assert index.landmark_covariances.shape == (len(landmark_map.points_world), 3, 3)


def test_a_map_off_the_wire_is_recognised_as_well() -> None:
    landmark_map = photographed()
    received = index_map(decode_map(encode_map(landmark_map)), "akaze", FEATURES)
    own = index_map(landmark_map, "akaze", FEATURES)
    # Landmarks come in another order off the wire.
    there, here = (
        sorted(
            (pixel.tobytes(), descriptor.tobytes())
            for pixel, descriptor in zip(
                np.rint(32.0 * index.entries.pixels), index.entries.descriptors, strict=True
            )
        )
        for index in (received, own)
    )
    assert there == here


@pytest.mark.parametrize("prior", [None, PRIOR], ids=["whole map", "guided"])
def test_a_photograph_is_localized_in_it(prior: Prior | None) -> None:
    index = index_map(photographed(), "akaze", FEATURES)
    fix = localize_intra(
        seen_from_truth(), CAMERA, MOUNTING, index, prior, TRUTH.rotation, LocalizationOptions()
    )
    assert isinstance(fix, Localized), fix
    assert fix.guided == (prior is not None)
    assert fix.n_inliers > 100
    error = TRUTH.local(fix.world_from_body)
    # 99.99 % of chi-square with 6 degrees of freedom.
    assert error @ np.linalg.solve(fix.covariance(), error) < 27.9
    assert_pose_close(fix.world_from_body, TRUTH, within_m=0.03, within_rad=0.01, least_m=1e-5)


def test_landmarks_of_another_detector_serve_the_geometry_only() -> None:
    landmark_map = photographed()
    n = len(landmark_map.points_world) // 2
    observed = landmark_map.observed_px.copy()
    observed[:n] += 2.4  # nobody finds these features there
    index = index_map(replace(landmark_map, observed_px=observed), "akaze", FEATURES)
    # But for the odd one that another feature happens to be near.
    assert (index.owner < n).sum() < 0.1 * n
    assert len(np.unique(index.owner[index.owner >= n])) == len(landmark_map.points_world) - n
    assert len(index.landmark_covariances) == len(landmark_map.points_world)


def test_a_map_without_a_landmark_to_recognise_is_refused() -> None:
    landmark_map = photographed()
    aside = np.linspace(2.25, 2.45, 10)[:, None, None]
    few = replace(
        landmark_map,
        points_world=landmark_map.points_world[:10],
        observed_px=landmark_map.observed_px[:10] + aside,
    )
    with pytest.raises(ValueError, match="no landmark that akaze finds again"):
        index_map(few, "akaze", FEATURES)
    empty = replace(few, points_world=np.zeros((0, 3)), observed_px=np.zeros((0, 2, 2)))
    with pytest.raises(ValueError, match="no landmark that akaze finds again"):
        index_map(empty, "akaze", FEATURES)


def test_images_that_cannot_be_used_are_refused() -> None:
    landmark_map = photographed()
    first, second = landmark_map.keyframes
    small = encode_image(np.zeros((24, 32), np.uint8), 50)
    webp = encode_image(decode_image(second.image_bytes, second.camera), 50, image_format="webp")
    for image, reason in (
        (b"", "neither an AV1"),
        (b"RIFF" + bytes(60), "neither an AV1"),
        (small, r"320x240 pixels: \(32, 24\)"),
        (first.image_bytes[:2000], "neither an AV1"),
        (webp[:2000], "cannot be decoded"),
    ):
        broken = replace(second, image_bytes=image)
        with pytest.raises(ValueError, match=reason):
            index_map(replace(landmark_map, keyframes=(first, broken)), "akaze", FEATURES)


@pytest.mark.parametrize("detector", ["akaze", "sift", "orb"])
@pytest.mark.parametrize("size", [(1, 1), (2, 3), (8, 8), (16, 1), (1, 300), (40, 12)])
def test_images_with_hardly_a_pixel_are_refused(detector: str, size: tuple[int, int]) -> None:
    landmark_map = photographed()
    camera = Camera(*size, 200.0, 200.0, 0.0, 0.0)
    image = encode_image(np.full((size[1], size[0]), 128, np.uint8), 50)
    tiny = tuple(replace(k, camera=camera, image_bytes=image) for k in landmark_map.keyframes)
    with pytest.raises(ValueError, match="finds again"):
        index_map(replace(landmark_map, keyframes=tiny), detector, FEATURES)  # type: ignore[arg-type]


def test_a_map_that_its_observations_do_not_fix_is_refused() -> None:
    landmark_map = photographed()
    behind = landmark_map.points_world * [-1.0, 1.0, 1.0]
    for broken in (
        replace(landmark_map, distances=()),
        replace(landmark_map, points_world=behind),
        replace(landmark_map, points_world=np.zeros_like(behind)),
    ):
        with pytest.raises(ValueError, match="do not fix it"):
            index_map(broken, "akaze", FEATURES)


@given(
    seed=st.integers(0, 2**32),
    kept=st.integers(1, 400),
    spread_m=st.sampled_from([0.0, 1e-6, 0.01, 1.0, 3e4]),
    moved_m=st.sampled_from([0.0, 1e-9, 0.5, 3e4]),
    turned_rad=st.sampled_from([0.0, 0.1, 3.0]),
    noise_px=st.sampled_from([0.3, 1e-6, 1e6]),
    focal=st.sampled_from([0.625, 0.01, 1000.0]),
    distortion=st.sampled_from([(), (-0.4, 0.1, 0.0, 0.0), (1e3, -1e3, 1e3, 1e3, -1e3)]),
    right=st.tuples(st.booleans(), st.booleans()),
)
@settings(max_examples=50)
def test_whatever_a_peer_claims_a_map_is_used_or_refused(
    seed: int,
    kept: int,
    spread_m: float,
    moved_m: float,
    turned_rad: float,
    noise_px: float,
    focal: float,
    distortion: tuple[float, ...],
    right: tuple[bool, bool],
) -> None:
    """Geometry within the bounds of the wire format, but otherwise any."""
    rng = np.random.default_rng(seed)
    honest = photographed()
    model: DistortionModel = "radial-tangential" if distortion else "none"
    camera = Camera(320, 240, 320.0 * focal, 320.0 * focal, 159.5, 119.5, model, distortion)
    points = honest.points_world if right[0] else np.zeros_like(honest.points_world)
    points = points + spread_m * rng.standard_normal(points.shape)
    claimed = replace(
        honest,
        keyframes=tuple(
            replace(
                k,
                camera=camera,
                world_from_body=perturbed(rng, k.world_from_body, moved_m, turned_rad),
                body_from_cam=k.body_from_cam
                if right[1]
                else Pose(random_rotation(rng), moved_m * rng.standard_normal(3)),
            )
            for k in honest.keyframes
        ),
        points_world=points[:kept],
        observed_px=honest.observed_px[:kept],
        pixel_noise_px=noise_px,
    )
    try:
        index = index_map(claimed, "akaze", FEATURES)
    except ValueError:
        return
    for prior in (None, PRIOR):
        fix = localize_intra(
            seen_from_truth(), CAMERA, MOUNTING, index, prior, None, LocalizationOptions()
        )
        assert isinstance(fix, Localized | NotLocalized)
        if isinstance(fix, Localized):
            assert np.all(np.linalg.eigvalsh(fix.covariance()) > 0)
