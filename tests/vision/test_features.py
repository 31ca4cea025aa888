import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vcl_companion.geometry.rotation import Array
from vcl_companion.vision.features import Detector, FeatureOptions, Features, Image, detect

DETECTORS: tuple[Detector, ...] = ("akaze", "sift", "orb")
WIDTH, HEIGHT = 320, 240
every_detector = pytest.mark.parametrize("detector", DETECTORS)


def blobs(rng: np.random.Generator, least_px: float, most_px: float) -> tuple[Image, Array]:
    """Draw Gaussian blobs, light and dark, at known sub-pixel positions."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    grid = np.stack(np.meshgrid(np.arange(40, 300, 60), np.arange(36, 220, 56)), axis=-1)
    centres = grid.reshape(-1, 2) + rng.uniform(-6.0, 6.0, (grid.size // 2, 2))
    image = np.full((HEIGHT, WIDTH), 120.0)
    for centre in centres:
        size_px = rng.uniform(least_px, most_px)
        height = rng.choice([-1.0, 1.0]) * rng.uniform(60.0, 110.0)
        image += height * np.exp(
            -((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / (2.0 * size_px**2)
        )
    return np.clip(np.round(image), 0, 255).astype(np.uint8), centres


def texture(rng: np.random.Generator, scale: int = 4) -> Image:
    small = rng.integers(0, 256, (HEIGHT // scale, WIDTH // scale)).astype(np.uint8)
    return np.kron(small, np.ones((scale, scale), np.uint8)).astype(np.uint8)


@pytest.mark.parametrize("detector", ["sift", "akaze"])
@pytest.mark.parametrize("sizes", [(1.5, 2.5), (2.5, 4.0), (4.0, 6.0)])
def test_a_blob_is_found_where_it_is(detector: Detector, sizes: tuple[float, float]) -> None:
    # OpenCV's SIFT without enable_precise_upscale sits 0.25 px off: this is the guard.
    rng = np.random.default_rng(1)
    errors: list[Array] = []
    n_blobs = 0
    for _ in range(4):
        image, centres = blobs(rng, *sizes)
        found = detect(image, detector, FeatureOptions())
        offset = found.pixels[:, None] - centres
        nearest = np.linalg.norm(offset, axis=2).argmin(axis=0)
        error = offset[nearest, np.arange(len(centres))]
        errors.append(error[np.linalg.norm(error, axis=1) < 1.5])
        n_blobs += len(centres)
    error = np.concatenate(errors)
    assert len(error) > 0.7 * n_blobs
    np.testing.assert_allclose(np.median(error, axis=0), 0.0, atol=0.02)
    np.testing.assert_allclose(error.mean(axis=0), 0.0, atol=0.05)
    assert 1e-4 < error.std() < 0.06


@every_detector
def test_the_same_image_gives_the_same_features(detector: Detector) -> None:
    image = texture(np.random.default_rng(2))
    one, two = (detect(image.copy(), detector, FeatureOptions()) for _ in range(2))
    assert len(one) > 50
    np.testing.assert_array_equal(one.pixels, two.pixels)
    np.testing.assert_array_equal(one.descriptors, two.descriptors)


@pytest.mark.parametrize("size_px", [(640, 480), (700, 250), (330, 1000)])
def test_tiles_of_an_image_show_what_the_whole_image_does(size_px: tuple[int, int]) -> None:
    rng = np.random.default_rng(13)
    coarse, fine = (rng.normal(0.0, 60.0, (size_px[1], size_px[0])) for _ in range(2))
    grey = 12.0 * cv2.GaussianBlur(coarse, (0, 0), 8.0) + 3.0 * cv2.GaussianBlur(fine, (0, 0), 1.5)
    image = np.clip(120.0 + grey, 0, 255).astype(np.uint8)
    every = FeatureOptions(max_features=20_000)
    tiled = detect(image, "sift", every)
    engine = cv2.SIFT.create(contrastThreshold=every.sift_contrast, enable_precise_upscale=True)
    keypoints, descriptors = engine.detectAndCompute(image, None)
    pixels = np.array([keypoint.pt for keypoint in keypoints])
    assert len(pixels) > 500
    assert len(tiled) == pytest.approx(len(pixels), rel=0.01)
    alike = np.sqrt(descriptors / descriptors.sum(axis=1, keepdims=True))
    near = cKDTree(tiled.pixels).query_ball_point(pixels, 0.05)
    is_there = [
        np.any(np.linalg.norm(tiled.descriptors[which] - descriptor, axis=1) < 0.1)
        for which, descriptor in zip(near, alike, strict=True)
    ]
    assert np.mean(is_there) > 0.98


@every_detector
def test_no_more_than_asked_for(detector: Detector) -> None:
    image = texture(np.random.default_rng(3))
    all_of_them = detect(image, detector, FeatureOptions(max_features=20_000))
    few = detect(image, detector, FeatureOptions(max_features=60))
    assert len(all_of_them) > 300
    assert len(few) == 60 if detector != "orb" else 40 <= len(few) <= 60  # ORB counts per octave
    assert len(few.pixels) == len(few.descriptors)


@pytest.mark.parametrize("detector", ["sift", "akaze"])
def test_a_rich_corner_cannot_take_all_places(detector: Detector) -> None:
    image = texture(np.random.default_rng(4)) // 4 + 90  # faint everywhere ...
    image[: HEIGHT // 3, : WIDTH // 4] = texture(np.random.default_rng(5))[
        : HEIGHT // 3, : WIDTH // 4
    ]  # ... and strong in one corner
    few = detect(image, detector, FeatureOptions(max_features=200)).pixels
    in_corner = ((few[:, 0] < WIDTH / 4) & (few[:, 1] < HEIGHT / 3)).mean()
    assert 0.01 < in_corner < 0.25  # the corner has 1/12 of the area
    columns, _ = np.histogram(few[:, 0], bins=4, range=(0, WIDTH))
    rows, _ = np.histogram(few[:, 1], bins=3, range=(0, HEIGHT))
    assert columns.min() > 20
    assert rows.min() > 30


def test_the_strongest_of_a_tile_stay() -> None:
    image, centres = blobs(np.random.default_rng(6), 2.0, 3.0)
    noisy = image + np.random.default_rng(7).integers(0, 6, image.shape).astype(np.uint8)
    options = FeatureOptions(max_features=150, sift_contrast=0.001)
    few = detect(noisy, "sift", options).pixels
    every = detect(noisy, "sift", FeatureOptions(sift_contrast=0.001)).pixels
    assert len(few) == 150 < 0.5 * len(every)
    on_blob, kept = (
        np.linalg.norm(pixels[:, None] - centres, axis=2).min(axis=0) < 1.0
        for pixels in (every, few)
    )
    assert on_blob.sum() >= 15
    np.testing.assert_array_equal(kept, on_blob)


@every_detector
@pytest.mark.parametrize("shape", [(HEIGHT, WIDTH), (0, 0), (1, 1), (1, WIDTH), (5, 7), (40, 40)])
def test_an_empty_or_tiny_image_has_no_features(detector: Detector, shape: tuple[int, int]) -> None:
    # One row high, OpenCV's AKAZE corrupts the heap: it must never get there.
    found = detect(np.full(shape, 90, np.uint8), detector, FeatureOptions())
    assert len(found) == 0
    assert found.pixels.shape == (0, 2)
    width = {"akaze": 61, "sift": 128, "orb": 32}[detector]
    assert found.descriptors.shape == (0, width)
    some = detect(texture(np.random.default_rng(8)), detector, FeatureOptions())
    assert some.descriptors.shape[1] == width
    assert some.descriptors.dtype == found.descriptors.dtype


def test_root_sift_has_length_one_and_is_never_negative() -> None:
    descriptors = detect(texture(np.random.default_rng(9)), "sift", FeatureOptions()).descriptors
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 1.0, atol=1e-5)
    assert descriptors.min() >= 0.0


def test_subset_keeps_the_order_asked_for() -> None:
    features = Features(
        np.arange(10.0).reshape(5, 2), np.arange(5, dtype=np.uint8)[:, None].repeat(32, axis=1)
    )
    index: NDArray[np.intp] = np.array([3, 0])
    chosen = features.subset(index)
    np.testing.assert_array_equal(chosen.pixels, [[6.0, 7.0], [0.0, 1.0]])
    np.testing.assert_array_equal(chosen.descriptors[:, 0], [3, 0])


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"max_features": 49}, "max_features"),
        ({"max_features": 20_001}, "max_features"),
        ({"akaze_threshold": 0.0}, "between 0 and 1"),
        ({"sift_contrast": float("nan")}, "between 0 and 1"),
    ],
)
def test_senseless_options_are_errors(changes: dict[str, float], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        FeatureOptions(**changes)  # type: ignore[arg-type]
