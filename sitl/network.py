"""A bad radio: what becomes of a datagram between sender and receiver; no clock, no socket.

What is modelled, in this order:

* *Rate.* Each sender has one transmitter of ``rate_bits_per_s`` (with ``shared`` all have
  one, as on one channel), which sends one datagram after the other, first come, first
  served. One that would wait for longer than ``queue_s`` is dropped (tail drop). Only the
  datagram's own bytes count. What is sent to several at once (``Network.broadcast``)
  takes the time once.
* *Partitions.* Who cannot hear whom, by a schedule (``sitl.partitions``).
* *Loss*, each datagram on its own, or in bursts: the chain of two states of Gilbert and
  Elliott, which loses everything in one of them and nothing in the other. Both lose the
  share ``loss``; ``burst`` is the mean number of datagrams lost in a row.
* *Corruption*: a run of 1 to 8 bytes, each replaced by another one.
* *Delay*, and up to ``jitter_s`` more, evenly distributed and drawn for each, so that
  datagrams less than that apart may overtake each other.
* *Reordering*: a datagram is held back ``reorder_hold_s`` more.
* *Duplication*: a second copy, delayed by its own draw.

Every directed link has random numbers of its own, from the seed and the two names: what
becomes of the nth datagram on a link's air does not hang on any other link.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sitl.partitions import Partition
from vcl_companion.errors import ConfigError

_MAX_WAIT_S = 60.0
_MAX_DAMAGED_BYTES = 8


@dataclass(frozen=True)
class NetworkOptions:
    """How bad the radio is; all zero: perfect.

    Attributes:
        loss: share of the datagrams that are lost.
        burst: mean number of datagrams lost in a row; None: each on its own.
        delay_s: how long each is on its way.
        jitter_s: up to how much longer.
        reorder: share that is held back so that others overtake it.
        reorder_hold_s: for how long.
        duplicate: share that arrives twice.
        corrupt: share that arrives with other bytes.
        rate_bits_per_s: of each sender; None: no bound.
        shared: all senders together have that rate.
        addressed: whether what is for several is sent to each of them by itself, as through an
            access point; else all hear what one sends.
        queue_s: for how long a datagram may wait for its transmission.
        partitions: who cannot hear whom when.
    """

    loss: float = 0.0
    burst: float | None = None
    delay_s: float = 0.0
    jitter_s: float = 0.0
    reorder: float = 0.0
    reorder_hold_s: float = 0.05
    duplicate: float = 0.0
    corrupt: float = 0.0
    rate_bits_per_s: float | None = None
    shared: bool = False
    addressed: bool = False
    queue_s: float = 0.5
    partitions: tuple[Partition, ...] = ()

    def __post_init__(self) -> None:
        for name in ("loss", "reorder", "duplicate", "corrupt"):
            share = getattr(self, name)
            if not 0.0 <= share <= 1.0:
                raise ConfigError(f"--{name} must be a share of 0 to 1, got {share}")
        waits = {
            "--delay": self.delay_s,
            "--jitter": self.jitter_s,
            "--queue": self.queue_s,
            "reorder_hold_s": self.reorder_hold_s,
        }
        for name, wait_s in waits.items():
            if not 0.0 <= wait_s <= _MAX_WAIT_S:
                raise ConfigError(f"{name} must be 0 to {_MAX_WAIT_S:.0f} s, got {wait_s}")
        if self.burst is not None:
            self._check_burst(self.burst)
        rate = self.rate_bits_per_s
        if rate is not None and not 0.0 < rate < math.inf:
            raise ConfigError(f"--rate must be positive bits per second, got {rate}")
        if self.shared and rate is None:
            raise ConfigError("--shared says who has the --rate; give one")

    def _check_burst(self, burst: float) -> None:
        if not 0.0 < self.loss < 1.0:
            raise ConfigError(f"--burst needs a --loss between 0 and 1, got {self.loss}")
        # So much loss in shorter bursts would need gaps of less than one datagram.
        shortest = max(1.0, self.loss / (1.0 - self.loss))
        if not shortest <= burst < math.inf:
            raise ConfigError(
                f"--burst must be a mean of {shortest:.3g} datagrams or more "
                f"at --loss {self.loss}, got {burst}"
            )


class Delivery(NamedTuple):
    """One datagram that arrives, and when."""

    due_s: float
    data: bytes


@dataclass
class Fate:
    """What became of the datagrams of one link, counted.

    ``offered`` is ``cut`` + ``queue_full`` + ``lost`` + ``delivered`` - ``duplicated``.

    Attributes:
        offered: given to the transmitter for this receiver.
        cut: not heard because of a partition.
        queue_full: dropped before their transmission.
        lost: on the air.
        corrupted: of the delivered ones, with other bytes; a duplicate is not counted again.
        held_back: of the delivered ones, so that others may overtake them.
        duplicated: second copies.
        delivered: arrived, second copies included.
        delay_sum_s: of all that arrived, from the offer to the arrival.
        delay_max_s: the longest of these.
    """

    offered: int = 0
    cut: int = 0
    queue_full: int = 0
    lost: int = 0
    corrupted: int = 0
    held_back: int = 0
    duplicated: int = 0
    delivered: int = 0
    delay_sum_s: float = 0.0
    delay_max_s: float = 0.0


class Transmitter:
    """Sends one datagram after the other at a rate; ``now_s`` never goes back."""

    def __init__(self, rate_bits_per_s: float, queue_s: float) -> None:
        self._rate_bits_per_s = rate_bits_per_s
        self._queue_s = queue_s
        self._free_at_s = -math.inf

    def sent_s(self, now_s: float, n_bytes: int) -> float | None:
        """Return when the last bit of a datagram is out; None when the queue is too long."""
        begins_s = max(now_s, self._free_at_s)
        if begins_s - now_s > self._queue_s:
            return None
        self._free_at_s = begins_s + 8.0 * n_bytes / self._rate_bits_per_s
        return self._free_at_s


class Air:
    """The way from one sender to one receiver, behind the transmitter."""

    def __init__(self, options: NetworkOptions, seed: np.random.SeedSequence) -> None:
        draws, damage = seed.spawn(2)
        self._options = options
        self._draws = np.random.default_rng(draws)
        # Of its own: how much a damage takes must not move what becomes of the next.
        self._damage = np.random.default_rng(damage)
        self._in_burst: bool | None = None

    def carry(self, offered_s: float, sent_s: float, data: bytes, fate: Fate) -> list[Delivery]:
        """Return what arrives of a datagram, and count it.

        Args:
            offered_s: when it was given to the transmitter.
            sent_s: when it was out.
            data: the datagram.
            fate: the link's counts.
        """
        options = self._options
        # Always as many: one impairment more leaves what the others do as it was.
        loses, damages, holds, doubles, late, later = self._draws.random(6).tolist()
        if self._loses(loses):
            fate.lost += 1
            return []
        if damages < options.corrupt and data:
            data = self._damaged(data)
            fate.corrupted += 1
        due_s = sent_s + options.delay_s
        held_s = 0.0
        if holds < options.reorder:
            held_s = options.reorder_hold_s
            fate.held_back += 1
        out = [Delivery(due_s + held_s + late * options.jitter_s, data)]
        if doubles < options.duplicate:
            out.append(Delivery(due_s + later * options.jitter_s, data))
            fate.duplicated += 1
        for delivery in out:
            delay_s = delivery.due_s - offered_s
            fate.delivered += 1
            fate.delay_sum_s += delay_s
            fate.delay_max_s = max(fate.delay_max_s, delay_s)
        return out

    def _loses(self, draw: float) -> bool:
        loss, burst = self._options.loss, self._options.burst
        if burst is None:
            return draw < loss
        if self._in_burst is None:
            self._in_burst = draw < loss
        elif self._in_burst:
            self._in_burst = draw >= 1.0 / burst
        else:
            self._in_burst = draw < loss / (1.0 - loss) / burst
        return self._in_burst

    def _damaged(self, data: bytes) -> bytes:
        out = bytearray(data)
        start = int(self._damage.integers(len(data)))
        run = int(self._damage.integers(1, _MAX_DAMAGED_BYTES + 1))
        for n in range(start, min(start + run, len(data))):
            out[n] ^= int(self._damage.integers(1, 256))
        return bytes(out)


class Network:
    """All directed links of a swarm, each made when it is first used.

    ``now_s`` of any clock must not go back from call to call. Deliveries come in the order
    of sending, not of arrival.

    Args:
        options: how bad it is.
        seed: of all random numbers.
    """

    def __init__(self, options: NetworkOptions, seed: int) -> None:
        self._options = options
        self._seed = seed
        self._transmitters: dict[str, Transmitter] = {}
        self._airs: dict[tuple[str, str], Air] = {}
        self._fates: dict[tuple[str, str], Fate] = {}

    @property
    def fates(self) -> Mapping[tuple[str, str], Fate]:
        """(sender, receiver) to what became of what was sent; only those that were used."""
        return self._fates

    def send(
        self, now_s: float, sender: str, receiver: str, data: bytes, flight_s: float | None = None
    ) -> list[Delivery]:
        """Return what arrives of a datagram to one receiver: nothing, once, or twice.

        Args:
            now_s: when it is sent.
            sender: who sends.
            receiver: to whom.
            data: the datagram.
            flight_s: time of the partitions' schedule; None: ``now_s``.
        """
        return [d for _, d in self.broadcast(now_s, sender, (receiver,), data, flight_s)]

    def broadcast(
        self,
        now_s: float,
        sender: str,
        receivers: Iterable[str],
        data: bytes,
        flight_s: float | None = None,
    ) -> list[tuple[str, Delivery]]:
        """Return to whom what arrives of a datagram that is on the air once; see ``send``."""
        sent_s = self._sent_s(now_s, sender, len(data))
        at_s = now_s if flight_s is None else flight_s
        out = []
        for receiver in receivers:
            fate = self._fates.setdefault((sender, receiver), Fate())
            fate.offered += 1
            if sent_s is None:
                fate.queue_full += 1
            elif any(p.cuts(at_s, sender, receiver) for p in self._options.partitions):
                fate.cut += 1
            else:
                air = self._air(sender, receiver)
                out += [(receiver, d) for d in air.carry(now_s, sent_s, data, fate)]
        return out

    def _sent_s(self, now_s: float, sender: str, n_bytes: int) -> float | None:
        rate = self._options.rate_bits_per_s
        if rate is None:
            return now_s
        owner = "" if self._options.shared else sender
        if owner not in self._transmitters:
            self._transmitters[owner] = Transmitter(rate, self._options.queue_s)
        return self._transmitters[owner].sent_s(now_s, n_bytes)

    def _air(self, sender: str, receiver: str) -> Air:
        key = (sender, receiver)
        if key not in self._airs:
            # The length keeps "a", "bc" and "ab", "c" apart.
            words = (self._seed, len(sender), *sender.encode(), *receiver.encode())
            self._airs[key] = Air(self._options, np.random.SeedSequence(words))
        return self._airs[key]
