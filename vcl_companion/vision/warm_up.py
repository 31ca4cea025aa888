"""Every compiled kernel once, so that no frame has to wait for the compiler.

The first time on a machine this takes half a minute and more, afterwards a
second: the code is kept on disk (``compiled``).
"""

from __future__ import annotations

import numpy as np

from vcl_companion.vision.absolute_pose import resect
from vcl_companion.vision.relative_pose import essential_candidates
from vcl_companion.vision.schur import eliminated


def warm_up() -> None:
    """Search a relative and an absolute pose in a small scene without noise, and adjust it."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-2.0, 2.0, (40, 2)), rng.uniform(4.0, 8.0, 40)])
    moved = points + np.array([1.0, 0.2, 0.1])
    ideal_a, ideal_b = points[:, :2] / points[:, 2:], moved[:, :2] / moved[:, 2:]
    essential_candidates(ideal_a, ideal_b, 320.0, rng)
    resect(ideal_b, points, 320.0, rng)
    eliminated(np.zeros((1, 6, 3)), np.zeros((1, 3, 3)), np.ones((1, 1), dtype=np.bool_))
