"""What bounds and paces the transfer of blobs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Literal

from vcl_companion.errors import ConfigError
from vcl_companion.swarm.budget import MAX_FRAME_BYTES
from vcl_companion.wire.chunks import CHUNK_DATA_BYTES
from vcl_companion.wire.header import MAX_BLOB_BYTES

Profile = Literal["wifi", "radio-57k", "radio-115k"]


@dataclass(frozen=True)
class Pace:
    """How fast and how patient transfers are on one kind of link.

    Attributes:
        rate_bytes_per_s: what we send to all peers together, on the link: MAVLink's
            bytes around each payload and its signature are counted.
        burst_bytes: how much may go at once after a pause. On a radio two frames: what
            waits in the radio, nothing more urgent can overtake.
        status_interval_s: how long a sender waits for an answer before it asks
            again (longer every time it gets none); a receiver answers within it.
        give_up_s: a sender without progress for this long fails.
        image_bytes: of a keyframe's image, at most: its quality is lowered for it. Of 9 kB
            maps are a centimetre worse (docs/network.md).
        quick_s: who comes to a swarm with a map waits for no more of it at first than takes so
            long to send (``daemon/map_parts.py``).
    """

    rate_bytes_per_s: float
    burst_bytes: int
    status_interval_s: float
    give_up_s: float
    image_bytes: int
    quick_s: float

    @property
    def quick_bytes(self) -> int:
        """How long a blob is that takes ``quick_s`` while nothing else is to be sent."""
        return int(self.quick_s / self.carried_in_s(1))

    def carried_in_s(self, n_bytes: int) -> float:
        """Return how long a blob takes with all that is around its chunks on the link."""
        return n_bytes * MAX_FRAME_BYTES / CHUNK_DATA_BYTES / self.rate_bytes_per_s


# A radio of 57,600 baud takes 5,760 bytes/s from us, and the air is everybody's; so 70 %.
PROFILES: Mapping[Profile, Pace] = MappingProxyType(
    {
        "wifi": Pace(400_000.0, 8192, 0.2, 30.0, 1_000_000, 0.25),
        "radio-57k": Pace(4_000.0, 2 * MAX_FRAME_BYTES, 1.0, 60.0, 9_000, 10.0),
        "radio-115k": Pace(8_000.0, 2 * MAX_FRAME_BYTES, 0.6, 45.0, 16_000, 8.0),
    }
)


@dataclass(frozen=True)
class TransferOptions:
    """How fast, how patient and how generous transfers are.

    Attributes:
        profile: the kind of link, which the next six follow from unless they are given.
        rate_bytes_per_s, burst_bytes, status_interval_s, give_up_s, image_bytes, quick_s: see
            ``Pace``.
        keep_partial_s: a receiver keeps an unfinished blob, and remembers a
            finished one, this long after it last heard of it.
        max_blob_bytes: longest blob accepted.
        max_incoming_per_peer: unfinished blobs a peer may have here, and that
            we send to a peer, at once.
        memory_quota_bytes: unfinished blobs of all peers; one peer gets at most half.
    """

    profile: Profile = "wifi"
    rate_bytes_per_s: float | None = None
    burst_bytes: int | None = None
    status_interval_s: float | None = None
    give_up_s: float | None = None
    image_bytes: int | None = None
    quick_s: float | None = None
    keep_partial_s: float = 120.0
    max_blob_bytes: int = MAX_BLOB_BYTES
    max_incoming_per_peer: int = 4
    memory_quota_bytes: int = 4 * MAX_BLOB_BYTES

    @cached_property
    def pace(self) -> Pace:
        """The profile's, with what was given in its place."""
        usual = PROFILES[self.profile]
        return Pace(
            usual.rate_bytes_per_s if self.rate_bytes_per_s is None else self.rate_bytes_per_s,
            usual.burst_bytes if self.burst_bytes is None else self.burst_bytes,
            usual.status_interval_s if self.status_interval_s is None else self.status_interval_s,
            usual.give_up_s if self.give_up_s is None else self.give_up_s,
            usual.image_bytes if self.image_bytes is None else self.image_bytes,
            usual.quick_s if self.quick_s is None else self.quick_s,
        )

    def __post_init__(self) -> None:
        if self.profile not in PROFILES:
            raise ConfigError(f"profile must be one of {', '.join(PROFILES)}: {self.profile}")
        pace = self.pace
        for name, value in (
            ("rate_bytes_per_s", pace.rate_bytes_per_s),
            ("status_interval_s", pace.status_interval_s),
            ("give_up_s", pace.give_up_s),
            ("quick_s", pace.quick_s),
            ("keep_partial_s", self.keep_partial_s),
        ):
            if not (math.isfinite(value) and value > 0):
                raise ConfigError(f"{name} must be positive: {value}")
        if pace.give_up_s < 2 * pace.status_interval_s:
            raise ConfigError(
                f"give_up_s ({pace.give_up_s}) must be at least twice status_interval_s "
                f"({pace.status_interval_s})"
            )
        if pace.burst_bytes < MAX_FRAME_BYTES:
            raise ConfigError(
                f"burst_bytes must hold one frame of {MAX_FRAME_BYTES}: {pace.burst_bytes}"
            )
        if pace.image_bytes < 1000:
            raise ConfigError(f"image_bytes must be 1000 or more: {pace.image_bytes}")
        if not 1 <= self.max_blob_bytes <= MAX_BLOB_BYTES:
            raise ConfigError(
                f"max_blob_bytes must be 1 to {MAX_BLOB_BYTES}: {self.max_blob_bytes}"
            )
        if not 1 <= self.max_incoming_per_peer <= 64:
            raise ConfigError(
                f"max_incoming_per_peer must be 1 to 64: {self.max_incoming_per_peer}"
            )
        if self.memory_quota_bytes < 4 * self.max_blob_bytes:
            raise ConfigError(
                f"memory_quota_bytes ({self.memory_quota_bytes}) must be at least four times "
                f"max_blob_bytes ({self.max_blob_bytes})"
            )
