"""Pixels of patches that a drone has told of its own image, against those of the encoded one."""

from __future__ import annotations

import numpy as np

from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.known_features import Index

# An encoder shifts no patch that is found again by more; all of an image by no more than this,
# root mean square, but for what so few patches have in common by chance.
_TOLD_PX, _COMMON_PX, _BY_CHANCE = 0.5, 0.03, 3.0
# Of fewer patches nothing of that kind can be told.
_LEAST_TOLD = 20


def agreed(found: Array, told_px: Array | None, landmarks: Index) -> Array:
    """Return (M, 2) what is found of landmarks in an encoded image, by the image itself if told.

    Only where both are about the same, and not if all of it is shifted, scaled or turned against
    the encoded image: an encoder errs here and there, and nothing else would show such a lie.
    """
    if told_px is None:
        return found
    told = told_px[landmarks]
    off = told - found
    agrees = np.linalg.norm(off, axis=1) < _TOLD_PX  # never where one of both is not there
    n = int(agrees.sum())
    if n < _LEAST_TOLD:
        return found
    at = (found[agrees] - found[agrees].mean(axis=0)) / max(float(found[agrees].std()), 1.0)
    basis = np.column_stack([np.ones(n), at])
    common = basis @ np.linalg.lstsq(basis, off[agrees], rcond=None)[0]
    by_chance = off[agrees].std() * np.sqrt(basis.shape[1] / n)
    if np.sqrt((common**2).mean()) > _COMMON_PX + _BY_CHANCE * by_chance:
        return found
    return np.where(agrees[:, None], told, found)
