"""A byte budget: what may be sent now, and when the next payload may."""

from __future__ import annotations

from vcl_companion.wire.header import MAX_PAYLOAD_BYTES

# What goes over the link around a payload: 12 bytes of MAVLink 2, 5 of TUNNEL's own fields
# and 13 of a signature, which is counted whether there is one or not.
FRAME_OVERHEAD_BYTES = 30
MAX_FRAME_BYTES = MAX_PAYLOAD_BYTES + FRAME_OVERHEAD_BYTES


class ByteBudget:
    """A token bucket; one payload may always go once there is room for the longest."""

    def __init__(self, rate_bytes_per_s: float, burst_bytes: int) -> None:
        self._rate_bytes_per_s = rate_bytes_per_s
        self._burst_bytes = float(burst_bytes)
        self._bytes = float(burst_bytes)
        self._at_s: float | None = None

    def refill(self, now_s: float) -> None:
        """Add what the time since the last call allows."""
        if self._at_s is not None:
            gained = max(now_s - self._at_s, 0.0) * self._rate_bytes_per_s
            self._bytes = min(self._bytes + gained, self._burst_bytes)
        self._at_s = now_s if self._at_s is None else max(now_s, self._at_s)

    def allows_one(self) -> bool:
        """Return whether one payload may go now."""
        # One byte of slack: at ``ready_at_s`` rounding must not ask for one more wait.
        return self._bytes > MAX_FRAME_BYTES - 1

    def spend(self, payload_bytes: int, copies: int = 1) -> None:
        """Take what a payload is on the link, so often."""
        self._bytes -= copies * (payload_bytes + FRAME_OVERHEAD_BYTES)

    def ready_at_s(self) -> float:
        """Return when one payload may go; minus infinity if it may already."""
        if self._at_s is None or self.allows_one():
            return float("-inf")
        return self._at_s + (MAX_FRAME_BYTES - self._bytes) / self._rate_bytes_per_s
