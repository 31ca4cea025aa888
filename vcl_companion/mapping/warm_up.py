"""Every compiled kernel of mapping and of what lies below it once."""

from __future__ import annotations

import numpy as np

from vcl_companion.geometry.camera import Camera
from vcl_companion.mapping.thinning import spread
from vcl_companion.vision import warm_up as vision


def warm_up() -> None:
    """Load, or the first time compile, all that frames and maps need."""
    vision.warm_up()
    spread(np.full((1, 1, 2), 10.0), [Camera(96, 96, 80.0, 80.0, 47.5, 47.5)], 1)
