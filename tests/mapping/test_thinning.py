"""Landmarks spread over the images: a crowd is thinned, and twins are one."""

import numpy as np
import pytest

from vcl_companion.geometry.camera import Camera
from vcl_companion.mapping.thinning import spread

CAMERAS = [Camera(640, 480, 320.0, 320.0, 319.5, 239.5)] * 2
UNSEEN = [np.nan, np.nan]


@pytest.mark.parametrize("apart_px", [0.0, 1.0, 3.0])
@pytest.mark.parametrize("along", [(1.0, 0.0), (0.0, 1.0), (-1.0, 1.0)])
def test_of_two_whose_patches_are_the_same_one_stays(
    apart_px: float, along: tuple[float, float]
) -> None:
    first = np.array([203.0, 104.0])
    observed = np.array([[first], [first + apart_px * np.array(along)]])
    assert spread(observed, CAMERAS[:1], 4).tolist() == [0]


@pytest.mark.parametrize("along", [(1.0, 0.0), (0.0, -1.0), (1.0, 1.0)])
def test_those_that_stand_apart_stay(along: tuple[float, float]) -> None:
    observed = np.array([[[203.0, 104.0]], [np.array([203.0, 104.0]) + 6.5 * np.array(along)]])
    assert spread(observed, CAMERAS[:1], 4).tolist() == [0, 1]


def test_what_another_image_shows_apart_stays() -> None:
    twins_in_one = np.array([[[203.0, 104.0], [50.0, 50.0]], [[204.0, 104.0], [90.0, 50.0]]])
    assert spread(twins_in_one, CAMERAS, 4).tolist() == [0, 1]
    twins_in_both = np.array([[[203.0, 104.0], [50.0, 50.0]], [[204.0, 104.0], [51.0, 50.0]]])
    assert spread(twins_in_both, CAMERAS, 4).tolist() == [0]


def test_of_twins_the_one_that_more_images_show_stays() -> None:
    observed = np.array([[[203.0, 104.0], UNSEEN], [[204.0, 104.0], [90.0, 50.0]]])
    assert spread(observed, CAMERAS, 4).tolist() == [1]


def test_a_cell_has_room_for_so_many() -> None:
    row = np.array([[[x, 20.0]] for x in (2.0, 12.0, 22.0, 32.0)])
    assert spread(row, CAMERAS[:1], 2).tolist() == [0, 1]
    assert spread(row, CAMERAS[:1], 4).tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("px", [(-0.5, -0.5), (639.5, 479.5), (-1e9, 240.0), (1e9, 1e9)])
def test_pixels_on_and_beyond_the_border_are_counted_too(px: tuple[float, float]) -> None:
    assert spread(np.array([[px], [px]]), CAMERAS[:1], 4).tolist() == [0]


def test_images_of_cameras_of_other_shapes_do_not_mix() -> None:
    """A wide and a high camera of a peer's map: neither is as wide as that and as high as this."""
    wide, high = (Camera(w, h, 320.0, 320.0, 0.0, 0.0) for w, h in ((65535, 100), (100, 65535)))
    observed = np.array(
        [
            [[65534.0, 99.0], [0.0, 0.0]],
            [[65534.0, 98.0], [1.0, 0.0]],
            [[65520.0, 99.0], [99.0, 65534.0]],
            [UNSEEN, [98.0, 65534.0]],
            [UNSEEN, [0.0, 65534.0]],
        ]
    )
    assert spread(observed, [wide, high], 4).tolist() == [0, 2, 4]
