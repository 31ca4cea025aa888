"""Images of frames that were heard, for a map that is still to come: the last ones, of each drone.

Nobody has asked us before we hear them. Of all of them only so many are held, and so many of
one drone: who sends one after the other pushes out its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from vcl_companion.wire.map_update import name_of_image

# Forty kilobytes each. A round has a few of one drone at most, so that half of all are many.
_N_HELD, _N_OF_ONE = 48, 24


class HeldImages:
    """Holds images by their names."""

    def __init__(self) -> None:
        self._images: dict[bytes, bytes] = {}
        self._whose: dict[bytes, int] = {}

    @property
    def by_name(self) -> Mapping[bytes, bytes]:
        """All that are here, the one that came last at the end."""
        return MappingProxyType(self._images)

    def keep(self, drone_id: int, image_bytes: bytes) -> None:
        """Hold an image; it stays that of the drone that gave it first."""
        name = name_of_image(image_bytes)
        self._images.pop(name, None)
        self._images[name] = image_bytes  # the last one is the last to go
        whose = self._whose.setdefault(name, drone_id)
        own = [other for other in self._images if self._whose[other] == whose]
        if len(own) > _N_OF_ONE:
            self._drop(own[0])
        if len(self._images) > _N_HELD:
            self._drop(next(iter(self._images)))

    def _drop(self, name: bytes) -> None:
        del self._images[name], self._whose[name]
