"""Whom a drone asks where it is (inter-MAV localization, IV-E), and how often."""

from __future__ import annotations

import math
from dataclasses import dataclass

from vcl_companion.localization.pair_evidence import InterOptions
from vcl_companion.options import require_positive
from vcl_companion.swarm.group import Group
from vcl_companion.vision.features import Detector

MOST_REQUEST_BYTES = 1 << 18
"""No host looks at a longer image."""


@dataclass(frozen=True)
class InterMavOptions(InterOptions):
    """When peers are asked where we are, and how a host looks for it.

    Attributes:
        every_n_frames: localized frames from one request to the next, by the default
            pipeline only while a peer may know better; a frame that is refused asks
            anyway, unless an older one's search has only begun. 0: never asks, still answers.
        least_interval_s: localized frames ask no more often, however many there are, nor
            do refused ones when nobody could answer the last time: looking costs each
            host a fifth of a second of one core.
        weak_sigma_m: a localized frame whose pose is less certain than this asks too, of those
            who have not shown lately that they know it no better.
        wait_s: a refused frame waits this long for an answer, beyond what the link takes to
            carry the request.
        max_hosts: peers asked at once; fewer where the link takes too long for so many.
        detector: features to match two drones' images by; among the map's.
        request_quality: of the frame that is sent, 1 to 100, at most; see ``map.image_format``.
        request_bytes: of its image, at most: the quality is lowered for it.
    """

    every_n_frames: int = 10
    # Ten frames at 5 Hz are due at the tenth, whatever their jitter.
    least_interval_s: float = 1.8
    weak_sigma_m: float = 0.3
    wait_s: float = 1.0
    max_hosts: int = 2
    detector: Detector = "sift"
    request_quality: int = 45
    request_bytes: int = 11_500

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.every_n_frames <= 100_000:
            raise ValueError(f"every_n_frames must lie in 0..100000, got {self.every_n_frames}")
        if not 0 <= self.least_interval_s <= 3600.0:
            raise ValueError(f"least_interval_s must lie in 0..3600, got {self.least_interval_s}")
        require_positive(self, "weak_sigma_m")
        if not 0 < self.wait_s <= 60.0:
            raise ValueError(f"wait_s must be above 0 up to 60, got {self.wait_s}")
        if not 1 <= self.max_hosts <= 16:
            raise ValueError(f"max_hosts must lie in 1..16, got {self.max_hosts}")
        if not 1 <= self.request_quality <= 100:
            raise ValueError(f"request_quality must lie in 1..100, got {self.request_quality}")
        if not 1000 <= self.request_bytes <= MOST_REQUEST_BYTES:
            raise ValueError(
                f"request_bytes must lie in 1000..{MOST_REQUEST_BYTES}, got {self.request_bytes}"
            )


# What peers knew so long ago tells no more whether they know better than we do.
_REMEMBERED_S = 30.0
# Who knows little of where it is tries again after so long whether they still do not.
_DOUBTED_S = 10.0
# What is hardly surer is not worth its bytes, nor the host's half second: all fly on one map,
# and what that is off by, everybody is.
_SURER = 0.8


@dataclass(frozen=True)
class _Answer:
    """How sure a peer's last answer was: its position's 1 sigma, m, and as a share of our own.

    None for that where we knew nothing, and had not known anything lately either.
    """

    sigma_m: float
    share: float | None
    at_ns: int


class HostChoice:
    """Remembers how sure each peer's last answer was.

    Args:
        group: who is there, on which map, and localized in it.
    """

    def __init__(self, group: Group) -> None:
        self._group = group
        self._told: dict[int, _Answer] = {}
        self._answered_at_ns: dict[int, int] = {}
        self._asked_in: dict[int, int] = {}
        self._n_requests = 0

    def choose(self, revision: bytes, at_most: int) -> list[int]:
        """Return the peers to ask now for a pose in a map.

        First those that were never asked, then the surest of those who answered,
        then those who could not tell, or have not answered yet: the one that was not asked for
        longest first.
        """
        able = self._able(revision)
        silent = self._group.is_silent
        able.sort(key=lambda p: (silent(p), self._sigma_m(p), self._asked_in.get(p, 0), p))
        chosen = able[:at_most]
        self._n_requests += 1
        for peer in chosen:
            self._asked_in[peer] = self._n_requests
        return chosen

    def may_know_better(self, revision: bytes, at_ns: int, *, is_weak: bool) -> bool:
        """Whether a peer may be surer of us than we are.

        Args:
            revision: of our map.
            at_ns: now, in the time of ``answered``.
            is_weak: whether we know little: then whoever has not been asked lately may, and who
                was only when we knew nothing. Else only those who were surer lately than we were
                then.
        """
        return any(self._may(peer, at_ns, is_weak) for peer in self._able(revision))

    def answered(self, peer: int, sigma_m: float, own_sigma_m: float, at_ns: int) -> None:
        """Note how sure an answer was, 1 sigma in the worst direction.

        Args:
            peer: whose.
            sigma_m: infinite for one that could not tell.
            own_sigma_m: what we knew ourselves; infinite for nothing.
            at_ns: when.
        """
        former = self._told.get(peer)
        self._answered_at_ns[peer] = at_ns
        share: float | None = None
        if math.isinf(sigma_m):
            share = math.inf
        elif math.isfinite(own_sigma_m):
            share = sigma_m / own_sigma_m
        elif former is not None and former.share is not None and math.isfinite(former.share):
            # Than nothing everybody knows more: what it was when we knew something stands.
            share, at_ns = former.share, former.at_ns
        self._told[peer] = _Answer(sigma_m, share, at_ns)

    def unanswered(self, peer: int, own_sigma_m: float, asked_at_ns: int) -> None:
        """Note that a peer has not answered in time: as one that could not tell.

        What it has said since it was asked stands.
        """
        if self._answered_at_ns.get(peer, asked_at_ns) <= asked_at_ns:
            self.answered(peer, math.inf, own_sigma_m, asked_at_ns)

    def lost(self, peer: int) -> None:
        """Forget a peer: when it comes back it is a new one."""
        self._told.pop(peer, None)
        self._answered_at_ns.pop(peer, None)
        self._asked_in.pop(peer, None)

    def _may(self, peer: int, at_ns: int, is_weak: bool) -> bool:
        told = self._told.get(peer)
        if told is None or told.share is None:
            return is_weak
        since_s = 1e-9 * (at_ns - told.at_ns)
        was_surer = told.share < _SURER and since_s <= _REMEMBERED_S
        return was_surer or (is_weak and since_s > _DOUBTED_S)

    def _sigma_m(self, peer: int) -> float:
        told = self._told.get(peer)
        if told is None:
            return math.inf if peer in self._asked_in else 0.0
        return told.sigma_m

    def _able(self, revision: bytes) -> list[int]:
        """Return the peers that see a map, and are believed.

        Who is localized by its own frames alone, or by another's word, could not tell: all that a
        request would do is keep the map away that both lack.
        """
        group = self._group
        return [
            peer
            for peer in group.maps.holders(revision)
            if peer != group.own_id
            and peer in group.trusted
            and (state := group.state_of(peer))
            and state.localized
            and state.tracked
        ]
