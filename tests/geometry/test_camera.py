import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.scenes import CAMERAS, EQUIDISTANT, PINHOLE, RADIAL_TANGENTIAL, RADIAL_TANGENTIAL_5
from vcl_companion.geometry.camera import Camera, DistortionModel
from vcl_companion.geometry.rotation import Array

cameras = pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.distortion_model)
# Barrel distortion without higher terms: stops growing at r = 1 / sqrt(0.9), 46 degrees aside.
FOLDING = Camera(640, 480, 400.0, 400.0, 320.0, 240.0, "radial-tangential", (-0.3, 0, 0, 0))


def pixel_grid(camera: Camera) -> Array:
    u, v = np.meshgrid(
        np.linspace(0, camera.width_px - 1, 21), np.linspace(0, camera.height_px - 1, 17)
    )
    return np.stack([u.ravel(), v.ravel()], axis=1)


@cameras
def test_every_pixel_of_the_image_comes_back(camera: Camera) -> None:
    pixels = pixel_grid(camera)
    ideal = camera.ideal_from_pixels(pixels)
    np.testing.assert_allclose(camera.pixels_from_ideal(ideal), pixels, rtol=0, atol=1e-6)


@given(
    st.sampled_from(CAMERAS), st.tuples(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6)),
    st.floats(0.01, 1e4),
)  # fmt: skip
def test_a_point_comes_back_as_its_ray(
    camera: Camera, xy: tuple[float, float], depth_m: float
) -> None:
    points_cam = depth_m * np.array([[*xy, 1.0]])
    ideal = camera.ideal_from_pixels(camera.project(points_cam))
    np.testing.assert_allclose(ideal, [xy], rtol=0, atol=1e-8)


@given(
    st.lists(st.floats(-0.15, 0.15), min_size=2, max_size=2),
    st.lists(st.floats(-0.003, 0.003), min_size=2, max_size=2),
    st.one_of(st.just([]), st.lists(st.floats(-0.03, 0.03), min_size=1, max_size=1)),
    st.tuples(st.floats(-0.55, 0.55), st.floats(-0.55, 0.55)),
)
def test_any_mild_radial_tangential_lens_is_inverted(
    radial: list[float], tangential: list[float], third: list[float], xy: tuple[float, float]
) -> None:
    camera = Camera(
        640, 480, 400.0, 410.0, 320.0, 240.0, "radial-tangential", (*radial, *tangential, *third)
    )
    ideal = camera.ideal_from_pixels(camera.pixels_from_ideal(np.array([xy])))
    np.testing.assert_allclose(ideal, [xy], rtol=0, atol=1e-8)


@given(
    st.lists(st.floats(-0.02, 0.02), min_size=4, max_size=4),
    st.floats(0.0, 1.4),
    st.floats(-np.pi, np.pi),
)
def test_any_mild_fisheye_is_inverted(
    coefficients: list[float], angle_rad: float, around_rad: float
) -> None:
    camera = Camera(
        640, 480, 260.0, 260.0, 320.0, 240.0, "equidistant", tuple(float(c) for c in coefficients)
    )
    direction = np.array([[np.cos(around_rad), np.sin(around_rad)]])
    ideal = np.tan(angle_rad) * direction
    pixels = camera.pixels_from_ideal(ideal)
    if np.isnan(pixels).any():  # so wide that this polynomial has stopped growing
        t2 = np.linspace(0.0, angle_rad, 2000) ** 2
        k1, k2, k3, k4 = coefficients
        slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
        assert slope.min() < 1e-3
    elif np.isfinite(found := camera.ideal_from_pixels(pixels)).all():
        np.testing.assert_allclose(np.arctan(np.linalg.norm(found)), angle_rad, atol=1e-6)
    else:
        assert angle_rad > 1.1, "Newton's method gave up inside the usual field of view"


@pytest.mark.parametrize("camera", [RADIAL_TANGENTIAL, RADIAL_TANGENTIAL_5])
def test_radial_tangential_is_opencvs(camera: Camera) -> None:
    rng = np.random.default_rng(1)
    points_cam = np.hstack([rng.uniform(-3, 3, (200, 2)), rng.uniform(4, 9, (200, 1))])
    matrix = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1]])
    theirs, _ = cv2.projectPoints(
        points_cam, np.zeros(3), np.zeros(3), matrix, np.array(camera.distortion)
    )
    np.testing.assert_allclose(camera.project(points_cam), theirs[:, 0], rtol=0, atol=1e-9)


def test_equidistant_is_opencvs() -> None:
    camera = EQUIDISTANT
    rng = np.random.default_rng(2)
    points_cam = np.hstack([rng.uniform(-6, 6, (200, 2)), rng.uniform(2, 9, (200, 1))])
    points_cam[0] = 0.0, 0.0, 1.0
    matrix = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1]])
    theirs, _ = cv2.fisheye.projectPoints(
        points_cam[:, None], np.zeros(3), np.zeros(3), matrix, np.array(camera.distortion)
    )
    np.testing.assert_allclose(camera.project(points_cam), theirs[:, 0], rtol=0, atol=1e-9)


@cameras
def test_nothing_is_seen_behind_the_camera(camera: Camera) -> None:
    points_cam = np.array([[0.1, 0.1, -1.0], [0.0, 0.0, 0.0], [np.nan, 0.0, 1.0], [0.1, 0.2, 1.0]])
    pixels = camera.project(points_cam)
    assert np.isnan(pixels[:2]).all()
    assert np.isnan(pixels[2]).any()
    assert np.isfinite(pixels[3]).all()


@cameras
def test_unseen_stays_unseen_and_harms_no_neighbour(camera: Camera) -> None:
    pixels = np.array([[np.nan, np.nan], [100.0, 200.0], [1e7, -1e7]])
    ideal = camera.ideal_from_pixels(pixels)
    assert np.isnan(ideal[0]).all()
    np.testing.assert_allclose(ideal[1], camera.ideal_from_pixels(pixels[1:2])[0], atol=1e-12)
    # Far outside: unknown, or a ray that really leads there; never a made-up one.
    back = camera.pixels_from_ideal(ideal[2:])
    assert np.isnan(back).all() or np.allclose(back, pixels[2:], rtol=1e-6)
    assert np.isnan(camera.ideal_from_pixels(np.full((3, 2), np.nan))).all()
    assert camera.ideal_from_pixels(np.zeros((0, 2))).shape == (0, 2)
    assert camera.project(np.zeros((0, 3))).shape == (0, 2)


def test_a_point_far_aside_is_not_folded_back_into_the_image() -> None:
    # At r = 1.8 the polynomial gives almost the principal point; no lens shows it there.
    points_cam = np.array([[1.05, 0.0, 1.0], [1.06, 0.0, 1.0], [1.8, 0.0, 1.0], [0.0, 5.0, 1.0]])
    pixels = FOLDING.project(points_cam)
    assert np.isfinite(pixels[0]).all()
    assert np.isnan(pixels[1:]).all()


def test_a_pixel_that_the_lens_cannot_produce_has_no_ray() -> None:
    widest_px = 400.0 * (2.0 / 3.0) / np.sqrt(0.9)
    pixels = np.array([[320.0 + widest_px - 1.0, 240.0], [320.0 + widest_px + 1.0, 240.0]])
    ideal = FOLDING.ideal_from_pixels(pixels)
    assert 0.9 < ideal[0, 0] < 1.0 / np.sqrt(0.9)
    assert np.isnan(ideal[1]).all()


def test_a_fisheye_that_folds_is_cut_too() -> None:
    camera = Camera(640, 480, 260.0, 260.0, 320.0, 240.0, "equidistant", (-0.3, 0.0, 0.0, 0.0))
    limit = np.tan(1.0 / np.sqrt(0.9))
    pixels = camera.pixels_from_ideal(np.array([[0.99 * limit, 0.0], [1.01 * limit, 0.0]]))
    assert np.isfinite(pixels[0]).all()
    assert np.isnan(pixels[1]).all()


def test_pixel_zero_is_the_centre_of_the_first_pixel() -> None:
    np.testing.assert_array_equal(PINHOLE.project(np.array([[0.0, 0.0, 2.0]])), [[319.5, 239.5]])
    assert PINHOLE.focal_px == 320.0


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"fx_px": 0.0}, "must be positive"),
        ({"width_px": 0}, "must be positive"),
        ({"cx_px": float("nan")}, "must be finite"),
        ({"distortion_model": "fov"}, "unknown distortion model"),
        ({"distortion": (0.1,)}, "coefficients, got 1"),
        ({"distortion_model": "radial-tangential", "distortion": (0.1,) * 3}, "4 or 5 coeff"),
        ({"distortion_model": "equidistant", "distortion": (0.1,) * 5}, "takes 4 coeff"),
    ],
)
def test_wrong_intrinsics_are_errors(changes: dict[str, object], why: str) -> None:
    fields: dict[str, object] = {
        "width_px": 640, "height_px": 480, "fx_px": 300.0, "fy_px": 300.0,
        "cx_px": 320.0, "cy_px": 240.0,
    }  # fmt: skip
    with pytest.raises(ValueError, match=why):
        Camera(**(fields | changes))  # type: ignore[arg-type]


@pytest.mark.parametrize("size", [5e-324, 1e-300, 1e300, -1e300])
@pytest.mark.parametrize("model", ["radial-tangential", "equidistant"])
def test_coefficients_of_no_lens_do_no_harm(model: DistortionModel, size: float) -> None:
    # They may come from a peer; that nothing raises is all that is asked.
    for k in range(4):
        distortion = tuple(size if i == k else 0.0 for i in range(4))
        camera = Camera(640, 480, 260.0, 260.0, 320.0, 240.0, model, distortion)
        with np.errstate(all="ignore"):
            camera.project(np.array([[0.3, 0.2, 1.0], [5.0, 5.0, 1.0]]))
            assert camera.ideal_from_pixels(pixel_grid(camera)).shape == (21 * 17, 2)


@cameras
def test_slopes_are_how_pixels_follow_the_ray(camera: Camera) -> None:
    ideal = camera.ideal_from_pixels(pixel_grid(camera))
    ideal = ideal[np.isfinite(ideal[:, 0])]
    slopes = camera.pixel_slopes(ideal)
    nudge = np.array([3e-4, -2e-4])
    moved = camera.pixels_from_ideal(ideal + nudge) - camera.pixels_from_ideal(ideal)
    predicted = slopes @ nudge
    assert np.abs(predicted - moved).max() < 2e-3
    assert np.abs(predicted).max() > 1e-2


def test_a_fisheye_shows_little_of_much_at_its_edge() -> None:
    camera = Camera(640, 480, 200.0, 200.0, 320.0, 240.0, "equidistant", (0.0,) * 4)
    angle = np.deg2rad(60.0)
    slope = camera.pixel_slopes(np.array([[np.tan(angle), 0.0]]))[0]
    # pixel = f theta along the radius: d theta / d tan theta = cos^2 theta.
    np.testing.assert_allclose(
        slope, np.diag([200.0 * np.cos(angle) ** 2, 200.0 * angle / np.tan(angle)]), rtol=1e-4
    )


def test_what_an_image_shows_begins_and_ends_at_its_pixels_edges() -> None:
    right, bottom = PINHOLE.width_px - 1.0, PINHOLE.height_px - 1.0
    corners = np.array([[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]])
    outwards = np.sign(corners - corners.mean(axis=0))
    assert PINHOLE.shows(corners + 0.49 * outwards, -0.5).all()
    assert not PINHOLE.shows(corners + 0.51 * outwards, -0.5).any()
    assert PINHOLE.shows(corners - 6.1 * outwards, 6.0).all()
    assert not PINHOLE.shows(corners - outwards * [7.0, 5.9], 6.0).any()
    assert not PINHOLE.shows(np.array([[np.nan, 5.0], [5.0, np.nan]]), -0.5).any()
