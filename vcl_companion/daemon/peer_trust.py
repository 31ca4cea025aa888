"""Peers that are not believed for a while: what follows from it here, and who is told.

A quarantined drone is still heard, and handed maps: it may be right again. What it says
of poses and maps, its frames, its requests and its vote count for nothing until its term
is over (``swarm/quarantine.py``). That is counted (``bars``), as is what no drone would send.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping

from vcl_companion.daemon.estimator import Estimator
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.refusals import Refusals
from vcl_companion.errors import WireError
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.messages import STATUS_TEXT_BYTES
from vcl_companion.links.texts import Severity
from vcl_companion.swarm.group import Group
from vcl_companion.swarm.quarantine import Evidence, Quarantine, Quarantined, QuarantineOptions
from vcl_companion.wire.header import VersionMismatchError

_log = logging.getLogger(__name__)

# One text in this time: several drones may be found out at once, and others have to say more.
_SAY_S = 1.0


class PeerTrust:
    """Collects evidence against peers, and says whom it has turned against.

    Args:
        group: told whose votes do not count.
        autopilot: told of every change, for the ground.
        estimator: whose jumps say that it was our own pose that was off.
        log: likewise.
        refusals: counts what is not taken.
        turned_away: told whose answers nobody waits for any more.
        options: thresholds and terms.
    """

    def __init__(
        self,
        group: Group,
        autopilot: AutopilotLink,
        estimator: Estimator,
        log: FlightLog,
        refusals: Refusals,
        turned_away: Callable[[int], None],
        options: QuarantineOptions,
    ) -> None:
        self._group = group
        self._autopilot = autopilot
        self._estimator = estimator
        self._log = log
        self._refusals = refusals
        self._turned_away = turned_away
        self._quarantine = Quarantine(options)
        self._n_resets = 0
        self._unsaid: dict[int, tuple[Severity, str]] = {}
        self._said_at_s = float("-inf")

    @property
    def n_terms(self) -> Mapping[int, int]:
        """How often each peer was quarantined, who ever was."""
        return self._quarantine.n_terms

    def why_not(self, peer: int) -> str:
        """Return why a peer is not believed now; empty if it is."""
        why = self._quarantine.why(peer)
        return f"quarantined: {why}" if why else ""

    def bars(self, peer: int, kind: str) -> bool:
        """Whether something is not taken because of who says it; that is counted."""
        if not self.why_not(peer):
            return False
        self._refusals.count(peer, f"{kind} of a quarantined drone")
        return True

    def malformed(self, peer: int, kind: str, error: WireError) -> None:
        """Count bytes that no drone sends; another version's are only not understood."""
        self._refusals.count(peer, kind, str(error))
        if not isinstance(error, VersionMismatchError):
            self.note(peer, Evidence.MALFORMED, f"{kind}: {error}")

    def note(self, peer: int, evidence: Evidence, why: str = "") -> None:
        """Take what speaks against a peer, or for it."""
        self._begin(self._quarantine.note(peer, evidence, why, self._now_s()))

    def heard(self, peer: int) -> None:
        """Count a message of a peer: there may be too many."""
        self._begin(self._quarantine.message(peer, self._now_s()))

    def judged(self, peer: int, contradiction: str) -> None:
        """Take whether the pose that a peer proposed fits our own; empty: it was taken."""
        if contradiction:
            self.note(peer, Evidence.POSE_CONTRADICTED, f"pose {contradiction}")
        else:
            self.note(peer, Evidence.POSE_TAKEN)

    def poll(self) -> None:
        """Release whose term is over, and say what has not been said; call it several times/s.

        When our own pose has jumped no pose is held against anybody: it was not theirs that
        was off.
        """
        if self._estimator.n_resets != self._n_resets:
            self._n_resets = self._estimator.n_resets
            self._quarantine.forgive(Evidence.POSE_CONTRADICTED)
        for released in self._quarantine.poll(self._now_s()):
            self._log.event("released", f"drone {released.peer}")
            _log.info("drone %d is believed again", released.peer)
            self._unsaid[released.peer] = (
                Severity.NOTICE,
                f"VCL: drone {released.peer} believed again",
            )
            self._group.distrust(self._quarantine.peers)
        self._say_next()

    def _begin(self, term: Quarantined | None) -> None:
        if term is None:
            return
        for_s = term.until_s - self._now_s()
        self._log.event("quarantine", f"drone {term.peer} for {for_s:.0f} s: {term.why}")
        _log.warning("drone %d is quarantined for %.0f s: %s", term.peer, for_s, term.why)
        text = f"VCL: drone {term.peer} quarantined: {term.why}"
        self._unsaid[term.peer] = (Severity.WARNING, text[:STATUS_TEXT_BYTES])
        self._group.distrust(self._quarantine.peers)
        self._turned_away(term.peer)
        self._say_next()

    def _say_next(self) -> None:
        """Say one thing, of each drone the newest only."""
        if self._unsaid and self._now_s() >= self._said_at_s + _SAY_S:
            self._said_at_s = self._now_s()
            self._autopilot.announce(*self._unsaid.pop(next(iter(self._unsaid))))

    def _now_s(self) -> float:
        return asyncio.get_running_loop().time()
