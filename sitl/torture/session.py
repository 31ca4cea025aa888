"""One drone under so many payloads: fed, watched, and what went wrong kept.

A session is made of its number alone, so that any payload of it can be had again: by
going through it once more up to there.
"""

from __future__ import annotations

import asyncio
import gc
import itertools
import logging
import os
import resource
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO

import numpy as np

import vcl_companion
from sitl.counted_loop import CountedLoop
from sitl.torture.dice import Dice
from sitl.torture.drone import TRANSFER, Role, TorturedDrone
from sitl.torture.judging import blob_outcome, payload_outcome
from sitl.torture.script import Script
from sitl.torture.valid import Overheard
from vcl_companion.clock import ManualClock
from vcl_companion.daemon.usage import give_back_freed

_ROLES = (Role(2, (1, 2, 3, 4), 1), Role(2, (1, 2, 3, 4), 2))
_STEP_S = 0.008
# Now and then so much passes at once: silence, what expires, what is given up.
_PAUSES, _PAUSES_S = 0.0015, (0.3, 3.0, 4.0, 8.0, 8.0, 40.0, 130.0)
# The drone's own tasks get a turn every so many payloads, and so many steps.
_TURN_EVERY, _STEPS_A_TURN = 8, 3
_FRAME_EVERY = 250
_KNOWS_WHERE = 0.6
_MEMORY_EVERY = 1000
_MOST_OUTCOMES, _MOST_KEPT = 500, 20
_OTHERS = "other outcomes"
_turns = itertools.count()
_PACKAGE = str(Path(vcl_companion.__file__).parent)


@dataclass(frozen=True)
class Failure:
    """A payload that did what none may do.

    Attributes:
        index: of the payload, for ``--only``.
        what: the exception and where it was raised.
        traceback: all of it.
        datagram: the bytes that came last.
        blob: the blob that they completed; empty if they did not.
    """

    index: int
    what: str
    traceback: str
    datagram: bytes
    blob: bytes = b""


@dataclass
class SessionResult:
    """What became of the payloads of one session.

    Attributes:
        session: its number.
        payloads: how many were fed.
        seconds: processor time that they took.
        pid: process that did it.
        turn: its place among those of the process.
        resident_bytes: the most memory that was seen in use.
        kept_bytes: memory in use when all of it was over.
        outcomes: counted by reason.
        failures: those kept.
        n_failures: all of them.
    """

    session: int
    payloads: int = 0
    seconds: float = 0.0
    pid: int = 0
    turn: int = 0
    resident_bytes: int = 0
    kept_bytes: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    failures: list[Failure] = field(default_factory=list)
    n_failures: int = 0


def run_session(
    seed: int, session: int, length: int, payloads: int, *, only_last: bool = False
) -> SessionResult:
    """Feed the first payloads of a session to a drone.

    Args:
        seed: of the whole run.
        session: its number.
        length: payloads of every session of the run, by which they are numbered.
        payloads: how many of this one to feed.
        only_last: whether only failures of the last of these are kept.
    """
    loop = CountedLoop()
    # A runner ends every task before it closes the loop, on Ctrl-C too.
    with asyncio.Runner(loop_factory=lambda: loop) as runner:
        result = runner.run(_Session(seed, session, length, loop).run(payloads, only_last))
    gc.collect()
    give_back_freed()
    result.kept_bytes = resident_bytes()
    return result


class _Session:
    """One drone after the other, of one session; see ``run_session``."""

    def __init__(self, seed: int, session: int, length: int, loop: CountedLoop) -> None:
        rng = np.random.default_rng((seed, session))
        self._dice = Dice(rng)
        self._role = _ROLES[session % len(_ROLES)]
        self._loop = loop
        self._clock = ManualClock()
        self._heard = Overheard()
        self._drone_rng = np.random.default_rng((seed, session, 1))
        self._script = Script(self._dice, self._role.own, self._role.peers, self._heard)
        self._first_index = session * length
        self._result = SessionResult(session)
        self._datagram = b""

    async def run(self, payloads: int, only_last: bool) -> SessionResult:
        """Feed payloads; return what became of them."""
        result = self._result
        result.pid, result.turn = os.getpid(), next(_turns)
        began_s = time.process_time()
        drone = self._new_drone()
        with _logged_errors() as logged:
            for k in range(payloads):
                self._datagram = self._script.next()
                self._let_time_pass()
                self._feed(drone)
                if k % _FRAME_EVERY == 0:
                    drone.see(self._script.valid.scene, knows_where=self._dice.chance(_KNOWS_WHERE))
                if k % _TURN_EVERY == 0:
                    for _ in range(_STEPS_A_TURN):
                        await asyncio.sleep(0)
                if k % _MEMORY_EVERY == 0:
                    result.resident_bytes = max(result.resident_bytes, resident_bytes())
                for error in logged:
                    self._fail(error)
                logged.clear()
                broken = drone.failures()
                for error in broken:
                    self._fail(_first_cause(error))
                if broken:
                    self._take_counts(drone)
                    await self._end(drone)
                    drone = self._new_drone()
                if only_last and k < payloads - 1:
                    result.failures.clear()
                result.payloads += 1
            self._take_counts(drone)
            await self._end(drone)
        result.seconds = time.process_time() - began_s
        return result

    def _new_drone(self) -> TorturedDrone:
        return TorturedDrone(self._role, self._heard, self._clock, self._drone_rng)

    async def _end(self, drone: TorturedDrone) -> None:
        try:
            await drone.end()
        except RuntimeError as error:
            self._fail(error)

    def _let_time_pass(self) -> None:
        self._loop.now_s += _STEP_S
        if self._dice.chance(_PAUSES):
            self._loop.now_s += self._dice.pick(_PAUSES_S)
        self._clock.advance_to(round(self._loop.now_s * 1e9))

    def _feed(self, drone: TorturedDrone) -> None:
        try:
            drone.link.hear(self._datagram)
        except Exception as error:
            self._fail(error)
        for tunnel in drone.link.tunnels:
            try:
                self._count(payload_outcome(tunnel))
            except Exception as error:
                self._fail(error)
        drone.link.tunnels.clear()
        for received in drone.transfers.blobs:
            try:
                self._count(blob_outcome(received.kind, received.blob, drone.stored, self._dice))
            except Exception as error:
                self._fail(error, received.blob)
        drone.transfers.blobs.clear()
        if drone.transfers.incoming_memory_bytes > TRANSFER.memory_quota_bytes:
            self._fail(AssertionError("unfinished blobs take more than their quota"))

    def _count(self, outcome: str, times: int = 1) -> None:
        outcomes = self._result.outcomes
        if outcome not in outcomes and len(outcomes) >= _MOST_OUTCOMES:
            outcome = _OTHERS
        outcomes[outcome] += times

    def _take_counts(self, drone: TorturedDrone) -> None:
        """Take in what the drone has counted itself."""
        for reason, times in drone.link.counters.refused.items():
            self._count(f"link: {reason}", times)
        for kind, times in drone.exchange.refused.items():
            self._count(f"exchange: {kind}", times)
        for what, times in drone.done.items():
            self._count(f"drone: {what}", times)
        for reason, times in drone.transfers.ended.items():
            self._count(f"transfer: {reason}", times)

    def _fail(self, error: BaseException, blob: bytes = b"") -> None:
        result = self._result
        result.n_failures += 1
        if len(result.failures) < _MOST_KEPT:
            index = self._first_index + result.payloads
            text = "".join(traceback.format_exception(error))
            result.failures.append(Failure(index, _in_a_line(error), text, self._datagram, blob))


@contextmanager
def _logged_errors() -> Iterator[list[BaseException]]:
    """Collect what was raised where nothing should be, and only logged; and every warning."""
    caught: list[BaseException] = []

    def warned(
        message: Warning | str, category: type[Warning], filename: str, lineno: int,
        file: TextIO | None = None, line: str | None = None,
    ) -> None:  # fmt: skip
        caught.append(category(f"{message} in {Path(filename).name}:{lineno}"))

    class Collector(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if record.exc_info and record.exc_info[1] is not None:
                caught.append(record.exc_info[1])

    log, collector = logging.getLogger("vcl_companion"), Collector()
    propagated, log.propagate = log.propagate, False
    log.addHandler(collector)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always")
            warnings.showwarning = warned
            yield caught
    finally:
        log.removeHandler(collector)
        log.propagate = propagated


def _first_cause(error: BaseException) -> BaseException:
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    return error


def _in_a_line(error: BaseException) -> str:
    """Return an exception, and the last line of the package that it passed."""
    where = ""
    for summary in traceback.extract_tb(error.__traceback__):
        if summary.filename.startswith(_PACKAGE):
            where = f" in {Path(summary.filename).name}:{summary.lineno}, {summary.name}"
    text = " ".join(str(error).split())[:120]
    return f"{type(error).__name__}: {text}{where}"


def resident_bytes() -> int:
    """Return the memory of this process that is in use now; the most ever where unknown."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except (OSError, ValueError, IndexError):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return pages * os.sysconf("SC_PAGE_SIZE")
