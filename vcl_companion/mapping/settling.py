"""What a map's own observations are worth when it is adjusted once more (IV-G).

A map's estimate knows more than the observations that it still has: those of keyframes that were
dropped have made it, and so have landmarks that were culled. Adjusted by what is left alone it
would move by as much as is not known any more. So its own observations are taken where its own
estimate puts them: by themselves they leave it where it is, as surely as they ever held it, and
what is new moves it by as much as it should.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.culling import Mask, of_landmarks
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.options import MapOptions
from vcl_companion.mapping.uncertainty import views_of
from vcl_companion.vision.bundle import Views, reprojection_residuals, residual_noise_px

# An observation further from where its map puts it is none of those that it was made of.
_SETTLED_PX, _SETTLED_SIGMAS = 0.5, 4.0
# An estimate that is made of its observations, and of more, misses them by no more than so many
# times the noise that it is said to have: two of one landmark, held by others, by twice as much as
# if they alone placed it. Maps in flight miss by 0.8 to 1.1 times.
_MADE_OF = 2.0


def settled(landmark_map: LandmarkMap, options: MapOptions) -> Array:
    """Return (N, V, 2) ideal image coordinates where a map's estimate puts what it observed.

    NaN where its estimate puts them elsewhere, and everywhere where most are elsewhere: that is
    not made of them, and they may put it right.
    """
    views = views_of(landmark_map)
    residuals = reprojection_residuals(views)
    # A map's word on its noise counts as far as observations may miss at all.
    noise_px = min(landmark_map.pixel_noise_px, options.max_error_px / _SETTLED_SIGMAS)
    out = np.full(landmark_map.observed_px.shape, np.nan)
    if residual_noise_px(residuals) < _MADE_OF * noise_px:
        most_px = max(_SETTLED_PX, _SETTLED_SIGMAS * noise_px)
        here = np.linalg.norm(residuals, axis=2) < most_px
        away = np.linalg.solve(views.slopes[here], residuals[here][..., None])[..., 0]
        out[here] = views.ideal[here] + away
    return out


def noise_of(views: Views, fits: Mask, good: Mask) -> float:
    """Return the noise, px, of observations that fit; those that were settled have none to show.

    Args:
        views: an estimate, with what was observed.
        fits: (N, V) observations that count.
        good: (N,) landmarks that do.
    """
    seen = of_landmarks(views, good)
    seen = replace(seen, ideal=np.where(fits[good][..., None], seen.ideal, np.nan))
    return residual_noise_px(reprojection_residuals(seen))
