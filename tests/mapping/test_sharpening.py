"""Windows that were taken for the next ones bend no map; a post before a wall stays."""

import numpy as np

from tests.mapping.windows import POST_M, WALL_M, bent_by_windows
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
