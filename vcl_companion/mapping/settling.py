"""What a map's own observations are worth when it is adjusted once more (IV-G).

A map's estimate knows more than the observations that it still has: those of keyframes that were
dropped have made it, and so have landmarks that were culled. Adjusted by what is left alone it
would move by as much as is not known any more. So its own observations are taken where its own
estimate puts them: by themselves they leave it where it is, as surely as they ever held it, and
what is new moves it by as much as it should.
"""

from __future__ import annotations

import numpy as np

from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.culling import Mask, of_landmarks
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.options import MapOptions
from vcl_companion.vision.bundle import Views, reprojection_residuals, residual_noise_px

# An observation further from where its map puts it is none of those that it was made of.
_SETTLED_PX, _SETTLED_SIGMAS = 0.5, 4.0
# An estimate that is made of its observations, and of more, misses them by no more than so many
# times the noise that it is said to have: two of one landmark, held by others, by twice as much as
# if they alone placed it. Maps in flight miss by 0.8 to 1.1 times.
_MADE_OF = 2.0


def believed_noise_px(landmark_map: LandmarkMap, options: MapOptions) -> float:
    """Return a map's word on its noise, as far as observations may miss at all."""
    return min(landmark_map.pixel_noise_px, options.max_error_px / _SETTLED_SIGMAS)


def settled(views: Views, noise_px: float) -> Array:
    """Return (N, V, 2) ideal image coordinates where a map's estimate puts what it observed.

    NaN where its estimate puts them elsewhere, and everywhere where most are elsewhere: that is
    not made of them, and they may put it right.

    Args:
        views: the map (``views_of``).
        noise_px: that it is said to have (``believed_noise_px``).
    """
    residuals = reprojection_residuals(views)
    out = np.full(views.ideal.shape, np.nan)
    if residual_noise_px(residuals) < _MADE_OF * noise_px:
        most_px = max(_SETTLED_PX, _SETTLED_SIGMAS * noise_px)
        here = np.linalg.norm(residuals, axis=2) < most_px
        away = np.linalg.solve(views.slopes[here], residuals[here][..., None])[..., 0]
        out[here] = views.ideal[here] + away
    return out


def noise_of(views: Views, good: Mask) -> float:
    """Return the noise, px, of what was observed; what was settled has none to show.

    Args:
        views: an estimate, with the observations that count.
        good: (N,) landmarks that do.
    """
    return residual_noise_px(reprojection_residuals(of_landmarks(views, good)))
