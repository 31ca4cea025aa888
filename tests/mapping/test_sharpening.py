"""Windows that were taken for the next ones bend no map, nor does a wrong first pose."""

import numpy as np
import pytest

from tests.mapping.rendered import rendered
from tests.mapping.windows import MOUNTING, POST_M, WALL_M, bent_by_windows, textured
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import exp_so3, log_so3
from vcl_companion.mapping.culling import placed
from vcl_companion.mapping.keyframe_image import encode_image
from vcl_companion.mapping.landmark_map import Keyframe, KnownDistance, LandmarkMap
from vcl_companion.mapping.options import MapOptions
from vcl_companion.mapping.sharpening import sharpened


def test_what_is_found_beside_its_neighbours_as_well_is_left_out() -> None:
    bent = bent_by_windows()
    landmark_map, kind = bent.landmark_map, bent.kind
    wrong = landmark_map.points_world[kind == 2, 0]
    assert len(wrong) >= 20
    assert (np.abs(wrong - WALL_M) > 2.0).all()

    sharp = sharpened(landmark_map, MapOptions(distance_sigma_m=0.01))

    away = sharp.points_world[:, 0]
    is_wall, is_post = np.abs(away - WALL_M) < 0.5, np.abs(away - POST_M) < 0.5
    assert is_wall.sum() > 0.8 * (kind == 0).sum()
    assert is_post.sum() > 0.8 * (kind == 1).sum()
    assert (~is_wall & ~is_post).sum() <= 2


@pytest.mark.parametrize("turned_deg", [8.0, -8.0])
def test_a_wrong_pose_before_a_nearly_flat_wall_is_found_to_be_wrong(turned_deg: float) -> None:
    # About the wall's middle: it is seen at the same pixels, all but for its relief.
    away_m, apart_m, n = 20.0, 5.5, 150
    rng = np.random.default_rng(3)
    camera = Camera(640, 480, 600.0, 600.0, 319.5, 239.5)
    depth_m, left_m = away_m + np.array([0.0, 0.2, -0.2, 0.1]), np.array([-6.0, -3.0, 0.0, 3.0])
    scene = [(d, e, textured(rng, 240, 120)) for d, e in zip(depth_m, left_m, strict=True)]
    inwards = exp_so3(np.array([0.0, 0.0, -np.arctan(apart_m / away_m)]))
    true = [Pose.identity(), Pose(inwards, np.array([0.0, apart_m, 0.0]))]
    panel = rng.integers(0, len(scene), n)
    across, down = rng.uniform(0.3, 2.7, n), rng.uniform(-2.7, 2.7, n)
    points = np.stack([depth_m[panel], left_m[panel] + across, down], axis=1)
    cams = [body @ MOUNTING for body in true]
    observed = np.stack([camera.project(cam.inverse().apply(points)) for cam in cams], axis=1)

    turn = exp_so3(np.array([0.0, 0.0, np.deg2rad(turned_deg)]))
    middle = np.array([away_m, 0.0, 0.0])
    place = middle - turn @ (middle - true[1].translation)
    wrong = Pose(inwards @ turn, apart_m * place / np.linalg.norm(place))
    keyframes = tuple(
        Keyframe(i + 1, i + 1, body, MOUNTING, camera, encode_image(image, 90))
        for i, (body, image) in enumerate(
            zip([true[0], wrong], [rendered(scene, cam, camera) for cam in cams], strict=True)
        )
    )
    ideal = camera.ideal_from_pixels(observed.reshape(-1, 2)).reshape(n, 2, 2)
    placed_wrongly = placed([k.world_from_body @ k.body_from_cam for k in keyframes], ideal)
    distance = KnownDistance(0, 1, apart_m, 0.001)

    sharp = sharpened(
        LandmarkMap(keyframes, placed_wrongly, observed, 0.5, ("akaze",), (distance,), b""),
        MapOptions(),
    )

    found = sharp.keyframes[1].world_from_body
    assert len(sharp.points_world) > 0.8 * n
    assert np.rad2deg(np.linalg.norm(log_so3(found.rotation.T @ inwards))) < 0.5
    assert np.linalg.norm(found.translation - true[1].translation) < 0.15
