"""Which peers are not believed for a while: evidence against each, weighed, and a term that ends.

A peer may be wrong with a right signature. Whatever it says is judged by itself, and refused
where that is wrong; here is added up who is wrong again and again. What speaks against a peer
and what speaks for it are log-likelihood ratios of a peer that is wrong and one that is right,
and their sum, never below zero, is Page's test (1954): a share of refusals that honest peers
have sinks back, a greater one climbs until the threshold.
"""

from __future__ import annotations

import enum
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from vcl_companion.options import require_positive


class Evidence(enum.Enum):
    """What a peer has said that speaks against it, or for it."""

    POSE_CONTRADICTED = enum.auto()
    POSE_TAKEN = enum.auto()
    MAP_CONTRADICTED = enum.auto()
    MAP_TAKEN = enum.auto()
    MALFORMED = enum.auto()
    FLOOD = enum.auto()


# How much each speaks against a peer. Of poses an honest peer has one in ten refused at most,
# one that is wrong seven. A map that contradicts the one in use is no noise, but two are
# needed: it may be ours that is wrong.
_WEIGHT = {
    Evidence.POSE_CONTRADICTED: 2.0,
    Evidence.POSE_TAKEN: -1.1,
    Evidence.MAP_CONTRADICTED: 6.0,
    Evidence.MAP_TAKEN: -6.0,
    Evidence.MALFORMED: 1.0,
    Evidence.FLOOD: 1.0,
}


@dataclass(frozen=True)
class QuarantineOptions:
    """When a peer is no more believed, and for how long.

    Attributes:
        threshold: sum of the evidence: six refused poses in a row, or two maps.
        window_s: what is older counts no more.
        least_interval_s: evidence of one kind against a peer counts once in this time: a
            moment in which something is amiss is one, however much is said in it.
        together_s: poses of several peers, refused within this time, speak against nobody.
        first_s: the first term; each further one is twice as long.
        longest_s: no term is longer.
        forgotten_s: after so long without another one the next term is the first again.
        flood_per_s: messages of one peer in a second, beyond which they are a flood; chunks
            have bounds of their own.
    """

    threshold: float = 12.0
    window_s: float = 120.0
    least_interval_s: float = 1.0
    together_s: float = 5.0
    first_s: float = 60.0
    longest_s: float = 1800.0
    forgotten_s: float = 3600.0
    flood_per_s: int = 50

    def __post_init__(self) -> None:
        require_positive(
            self, "threshold", "window_s", "first_s", "longest_s", "forgotten_s", "flood_per_s"
        )
        if not self.least_interval_s >= 0:
            raise ValueError(f"least_interval_s must not be negative, got {self.least_interval_s}")


@dataclass(frozen=True)
class Quarantined:
    """A peer is not believed from now on, until when, and why."""

    peer: int
    until_s: float
    why: str


@dataclass(frozen=True)
class Released:
    """A peer is believed again."""

    peer: int


# What is remembered of a peer: of each kind one a second at most counts.
_N_REMEMBERED = 512


@dataclass
class _Peer:
    """What is known of one peer.

    Attributes:
        heard: time, kind and reason of what counts, in its order.
        counted_at_s: when each kind counted last.
        term: why it is quarantined and until when; None while it is not.
        n_terms: how often it was.
        ended_at_s: when the last term was over.
        second: the second that messages are being counted in, and how many.
    """

    heard: deque[tuple[float, Evidence, str]] = field(
        default_factory=lambda: deque(maxlen=_N_REMEMBERED)
    )
    counted_at_s: dict[Evidence, float] = field(default_factory=dict)
    term: Quarantined | None = None
    n_terms: int = 0
    ended_at_s: float = float("-inf")
    second: tuple[float, int] = (float("-inf"), 0)


class Quarantine:
    """Adds up what speaks against each peer; only what it is told changes it, and time.

    Args:
        options: thresholds and terms.
    """

    def __init__(self, options: QuarantineOptions) -> None:
        self._options = options
        self._peers: dict[int, _Peer] = {}

    @property
    def peers(self) -> frozenset[int]:
        """Who is not believed now."""
        return frozenset(peer for peer, known in self._peers.items() if known.term is not None)

    @property
    def n_terms(self) -> Mapping[int, int]:
        """How often each peer was quarantined, who ever was."""
        return MappingProxyType(
            {p: known.n_terms for p, known in self._peers.items() if known.n_terms}
        )

    def why(self, peer: int) -> str:
        """Return why a peer is not believed; empty if it is."""
        known = self._peers.get(peer)
        return "" if known is None or known.term is None else known.term.why

    def note(self, peer: int, evidence: Evidence, why: str, now_s: float) -> Quarantined | None:
        """Take what speaks against a peer, or for it.

        Args:
            peer: who said it; what it says during a term is not judged.
            evidence: what it was.
            why: what was wrong with it, for people.
            now_s: the time, which never goes back.

        Returns:
            The term that begins with it, if one does.
        """
        options = self._options
        known = self._peers.setdefault(peer, _Peer())
        if known.term is not None:
            return None
        last_s = known.counted_at_s.get(evidence, float("-inf"))
        if _WEIGHT[evidence] > 0 and now_s < last_s + options.least_interval_s:
            return None
        known.counted_at_s[evidence] = now_s
        if evidence is Evidence.POSE_CONTRADICTED and self._others_too(peer, now_s):
            return None
        known.heard.append((now_s, evidence, why))
        while known.heard[0][0] < now_s - options.window_s:
            known.heard.popleft()
        if _WEIGHT[evidence] < 0 or _weighed(known.heard) < options.threshold:
            return None
        if now_s >= known.ended_at_s + options.forgotten_s:
            known.n_terms = 0
        # Before the power grows beyond what a float holds the term is the longest for long.
        term_s = min(options.first_s * 2.0 ** min(known.n_terms, 30), options.longest_s)
        known.n_terms += 1
        known.term = Quarantined(peer, now_s + term_s, why)
        return known.term

    def message(self, peer: int, now_s: float) -> Quarantined | None:
        """Count a message of a peer; return the term that begins if there have been too many."""
        known = self._peers.setdefault(peer, _Peer())
        since_s, n = known.second
        known.second = (since_s, n + 1) if now_s < since_s + 1.0 else (now_s, 1)
        if known.second[1] <= self._options.flood_per_s:
            return None
        why = f"more than {self._options.flood_per_s} messages/s"
        return self.note(peer, Evidence.FLOOD, why, now_s)

    def _others_too(self, peer: int, now_s: float) -> bool:
        """Whether another peer's pose was refused lately: then ours may be the one that is off."""
        contradicted = Evidence.POSE_CONTRADICTED
        return any(
            known.counted_at_s.get(contradicted, float("-inf")) > now_s - self._options.together_s
            for other, known in self._peers.items()
            if other != peer and known.term is None
        )

    def forgive(self, evidence: Evidence) -> None:
        """Take back what counts of one kind against all: it was we who were wrong."""
        for known in self._peers.values():
            kept = [one for one in known.heard if one[1] is not evidence]
            known.heard.clear()
            known.heard.extend(kept)

    def poll(self, now_s: float) -> list[Released]:
        """Return whose term is over; nothing is held against them any more but its number."""
        over = [
            peer
            for peer, known in self._peers.items()
            if known.term is not None and now_s >= known.term.until_s
        ]
        for peer in over:
            known = self._peers[peer]
            known.term, known.ended_at_s = None, now_s
            known.heard.clear()
            known.counted_at_s.clear()
        return [Released(peer) for peer in sorted(over)]


def _weighed(heard: deque[tuple[float, Evidence, str]]) -> float:
    """Return the sum of evidence, in its order, that never falls below zero."""
    total = 0.0
    for _, evidence, _ in heard:
        total = max(total + _WEIGHT[evidence], 0.0)
    return total
