"""What peers sent in vain: counted by kind, and told to the log once of each."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping
from types import MappingProxyType

from vcl_companion.daemon.flight_log import FlightLog

_log = logging.getLogger(__name__)


class Refusals:
    """Counts what was not accepted from peers; ``log`` is told of the first of each kind."""

    def __init__(self, log: FlightLog) -> None:
        self._log = log
        self._times: Counter[tuple[int, str]] = Counter()

    @property
    def by_kind(self) -> Mapping[str, int]:
        """How often each kind was refused so far, of all peers."""
        total: Counter[str] = Counter()
        for (_, kind), times in self._times.items():
            total[kind] += times
        return MappingProxyType(total)

    def count(self, peer: int, kind: str, detail: str = "") -> None:
        """Count one. Only the kind is a key: a detail may hold any number a peer likes."""
        self._times[peer, kind] += 1
        if self._times[peer, kind] == 1:
            reason = f"{kind}: {detail}" if detail else kind
            self._log.event("refused", f"from drone {peer}: {reason}")
            _log.warning("refused from drone %d: %s", peer, reason)
