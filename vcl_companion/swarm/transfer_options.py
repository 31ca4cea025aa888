"""What bounds and paces the transfer of blobs."""

from __future__ import annotations

import math
from dataclasses import dataclass

from vcl_companion.errors import ConfigError
from vcl_companion.wire.header import MAX_BLOB_BYTES, MAX_PAYLOAD_BYTES


@dataclass(frozen=True)
class TransferOptions:
    """How fast, how patient and how generous transfers are.

    Attributes:
        rate_bytes_per_s: payload bytes to all peers together, statuses included.
        burst_bytes: how much may go at once after a pause.
        status_interval_s: how long a sender waits for an answer before it asks
            again (longer every time it gets none); a receiver answers within it.
        give_up_s: a sender without progress for this long fails.
        keep_partial_s: a receiver keeps an unfinished blob, and remembers a
            finished one, this long after it last heard of it.
        max_blob_bytes: longest blob accepted.
        max_incoming_per_peer: unfinished blobs a peer may have here, and that
            we send to a peer, at once.
        memory_quota_bytes: unfinished blobs of all peers; one peer gets at most half.
    """

    rate_bytes_per_s: float = 200_000.0
    burst_bytes: int = 8192
    status_interval_s: float = 0.2
    give_up_s: float = 30.0
    keep_partial_s: float = 120.0
    max_blob_bytes: int = MAX_BLOB_BYTES
    max_incoming_per_peer: int = 4
    memory_quota_bytes: int = 4 * MAX_BLOB_BYTES

    def __post_init__(self) -> None:
        for name in ("rate_bytes_per_s", "status_interval_s", "give_up_s", "keep_partial_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ConfigError(f"{name} must be positive: {value}")
        if self.give_up_s < 2 * self.status_interval_s:
            raise ConfigError(
                f"give_up_s ({self.give_up_s}) must be at least twice status_interval_s "
                f"({self.status_interval_s})"
            )
        if self.burst_bytes < MAX_PAYLOAD_BYTES:
            raise ConfigError(
                f"burst_bytes must hold one payload of {MAX_PAYLOAD_BYTES}: {self.burst_bytes}"
            )
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
