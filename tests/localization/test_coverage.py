"""The share of an image that landmarks fill."""

from __future__ import annotations

import numpy as np
import pytest

from tests.scenes import PINHOLE
from vcl_companion.localization.coverage import covered_share


@pytest.mark.parametrize("share", [0.25, 0.5, 1.0])
def test_landmarks_over_a_part_of_the_image_cover_that_part(share: float) -> None:
    rng = np.random.default_rng(1)
    size = np.array([PINHOLE.width_px * share, PINHOLE.height_px])
    assert covered_share(rng.uniform(0.0, size, (4000, 2)) - 0.5, PINHOLE) == share


def test_a_crowd_covers_no_more_than_one_of_them() -> None:
    crowd = np.tile([100.0, 90.0], (500, 1))
    assert covered_share(crowd, PINHOLE) == covered_share(crowd[:1], PINHOLE) == 1 / 48
    beside = np.array([[-3.0, 5.0], [5.0, PINHOLE.height_px + 2.0]])
    assert covered_share(beside, PINHOLE) == covered_share(np.zeros((0, 2)), PINHOLE) == 0.0
