"""By how much a camera turned between two images, and None where they do not tell."""

import numpy as np

from tests.daemon import turned_by_hand as by_hand
from vcl_companion.geometry.rotation import log_so3
from vcl_companion.vision.image_turn import image_turn


def test_a_turn_is_seen_to_tenths_of_a_degree() -> None:
    images = by_hand.images()[:40]
    rng = np.random.default_rng(1)
    sits, off_deg = by_hand.BODY_FROM_CAM.rotation, []
    for k in range(len(images) - 1):
        start, end = (by_hand.world_from_body(i / by_hand.RATE_HZ).rotation for i in (k, k + 1))
        turn = image_turn(images[k], images[k + 1], by_hand.LENS, rng)
        assert turn is not None
        off = turn.T @ (start @ sits).T @ (end @ sits)
        off_deg.append(np.rad2deg(np.linalg.norm(log_so3(off))))
    assert 0.001 < np.median(off_deg) < 0.15
    assert max(off_deg) < 0.4


def test_what_shows_nothing_or_another_place_tells_of_no_turn() -> None:
    rng = np.random.default_rng(1)
    image = by_hand.images()[0]
    grey = np.full_like(image, 90)
    noise = rng.integers(0, 255, image.shape, dtype=np.uint8)
    for before, after in ((grey, grey), (image, grey), (image, noise)):
        assert image_turn(before, after, by_hand.LENS, rng) is None
