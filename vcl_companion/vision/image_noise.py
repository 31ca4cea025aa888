"""How noisy an image is, by the image alone."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vcl_companion.compiled import compiled
from vcl_companion.geometry.rotation import Array
from vcl_companion.vision.features import Image

# White noise of 1 sigma gives 6 by the mask [1 -2 1] across and down.
_SIGMA_OF_MEAN = math.sqrt(math.pi / 2.0) / 6.0
_BLOCK_PX = 40
# Rows that are looked at, apart: four hundred pixels of a block are enough.
_STEP_PX = 4
# Of the blocks, sorted by how restless they are: the calmest have no texture, if any have none.
_CALMEST = 0.1
# Beyond these a block's noise is cut off.
_DARKEST, _BRIGHTEST = 8.0, 247.0


def grey_noise(image: Image) -> float:
    """Return the noise of an image's pixels, 1 sigma, grey levels.

    J. Immerkaer, Fast Noise Variance Estimation, CVIU 1996, of the calmest blocks: there texture
    makes least of what is seen. Of a camera's images they give a few tenths by daylight.

    Args:
        image: (H, W) uint8.

    Returns:
        0 where every block is black or white, or there is none.
    """
    grey, restless = _blocks(np.ascontiguousarray(image))
    seen = restless[(grey >= _DARKEST) & (grey <= _BRIGHTEST)]
    return float(np.sort(seen)[int(_CALMEST * seen.size)]) * _SIGMA_OF_MEAN if seen.size else 0.0


@compiled
def _blocks(image: NDArray[np.uint8]) -> tuple[Array, Array]:
    """Return the mean grey of each whole block, and what the mask gives there."""
    height, width = image.shape
    down, across = (height - 2) // _BLOCK_PX, (width - 2) // _BLOCK_PX
    n = _BLOCK_PX * (_BLOCK_PX // _STEP_PX)
    grey, restless = np.empty(down * across), np.empty(down * across)
    for i in range(down):
        for j in range(across):
            greys, steps = 0, 0
            for y in range(i * _BLOCK_PX + 1, (i + 1) * _BLOCK_PX + 1, _STEP_PX):
                above, here, under = image[y - 1], image[y], image[y + 1]
                for x in range(j * _BLOCK_PX + 1, (j + 1) * _BLOCK_PX + 1):
                    left = np.int32(above[x - 1]) - 2 * np.int32(here[x - 1]) + under[x - 1]
                    mid = np.int32(above[x]) - 2 * np.int32(here[x]) + under[x]
                    right = np.int32(above[x + 1]) - 2 * np.int32(here[x + 1]) + under[x + 1]
                    greys += here[x]
                    steps += abs(left - 2 * mid + right)
            grey[i * across + j] = greys / n
            restless[i * across + j] = steps / n
    return grey, restless
