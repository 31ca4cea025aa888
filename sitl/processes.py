"""Child processes of a flight: started on a leash, watched, ended by their own process id."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import sys
from collections.abc import Coroutine, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from vcl_companion.errors import VclError

Result = TypeVar("Result")

_LEASH = Path(__file__).with_name("leash.py")
_TAIL_BYTES = 16384
_KILL_WAIT_S = 5.0
# A broken pipe or socket is seen before the exit of the process behind it; look twice.
_BLAME_WAIT_S = 2.0
_LOOK_S = 0.05
# A disk with less has no room for a last word.
_FULL_BYTES = 4096


class FlightError(VclError):
    """A flight could not go on: which process, and why, in one line."""


@dataclass(frozen=True, eq=False)
class Child:
    """One process of ours.

    Attributes:
        name: for people, like "daemon of mav0".
        process: the process; its standard error goes to ``stderr_path``.
        stderr_path: what it complained about.
    """

    name: str
    process: asyncio.subprocess.Process
    stderr_path: Path

    @property
    def running(self) -> bool:
        """Whether it has not ended yet."""
        return self.process.returncode is None

    def last_words(self) -> str:
        """Return the last line of its standard error, empty when it said nothing."""
        try:
            with self.stderr_path.open("rb") as file:
                file.seek(0, os.SEEK_END)
                file.seek(max(0, file.tell() - _TAIL_BYTES))
                lines = file.read().decode("utf-8", "replace").splitlines()
        except OSError:
            return ""
        return next((line.strip() for line in reversed(lines) if line.strip()), "")

    def obituary(self) -> str:
        """Return how it ended and why, in one line."""
        code = self.process.returncode
        if code is None:
            how = "is still running"
        elif code < 0:
            how = f"was ended by {_signal_name(-code)}"
        else:
            how = f"ended with exit code {code}"
        if words := self.last_words():
            return f"{self.name} {how}: {words}"
        folder = self.stderr_path.parent
        if folder.is_dir() and shutil.disk_usage(folder).free < _FULL_BYTES:
            return f"{self.name} {how}: the disk of {folder} is full"
        return f"{self.name} {how} without a word"


async def start_child(
    name: str,
    command: Sequence[str],
    *,
    log_prefix: Path,
    environment: Mapping[str, str],
    piped: bool = False,
) -> Child:
    """Start a process in its own group, so that a Ctrl-C of the terminal is ours alone.

    Not in its own session: Linux gives each the same share of the processors (autogroup), and
    what nobody waits for on one drone would take as much as what all wait for on another.

    Args:
        name: for people.
        command: absolute program and arguments.
        log_prefix: ``<prefix>.stderr``, ``<prefix>.pid`` and, unless ``piped``,
            ``<prefix>.stdout`` are written.
        environment: the whole environment.
        piped: keep standard input and output as pipes.
    """
    stderr_path = log_prefix.with_name(log_prefix.name + ".stderr")
    stdout_path = log_prefix.with_name(log_prefix.name + ".stdout")
    leash = (sys.executable, "-I", "-S", str(_LEASH), str(os.getpid()))
    with stderr_path.open("wb") as stderr, open(os.devnull if piped else stdout_path, "wb") as out:
        process = await asyncio.create_subprocess_exec(
            *leash,
            *command,
            stdin=asyncio.subprocess.PIPE if piped else asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE if piped else out,
            stderr=stderr,
            env=dict(environment),
            process_group=0,
        )
    log_prefix.with_name(log_prefix.name + ".pid").write_text(f"{process.pid}\n")
    return Child(name, process, stderr_path)


async def unless_one_ends(children: Sequence[Child], work: Coroutine[Any, Any, Result]) -> Result:
    """Do the work; give it up as soon as any of the children ends.

    Args:
        children: who is looked at again and again, so that a live list may change.
        work: what is done.

    Raises:
        FlightError: a child ended: which, how, and its last line. Also in place
            of an error of the work itself when a child's end explains it.
    """
    doing = asyncio.ensure_future(work)
    try:
        while not doing.done() and all(child.running for child in children):
            await asyncio.wait([doing], timeout=_LOOK_S)
        if doing.done() and doing.exception() is not None:
            with suppress(TimeoutError):
                async with asyncio.timeout(_BLAME_WAIT_S):
                    while all(child.running for child in children):
                        await asyncio.sleep(_LOOK_S)
        for child in children:
            if not child.running:
                raise FlightError(child.obituary())
        return await doing
    finally:
        doing.cancel()
        await asyncio.gather(doing, return_exceptions=True)


async def kill_child(child: Child) -> None:
    """Kill a child with all that it has started, as systemd would, and wait until it is gone."""
    with suppress(ProcessLookupError):
        os.killpg(child.process.pid, signal.SIGKILL)
    await child.process.wait()


async def end_children(children: Iterable[Child], timeout_s: float) -> list[Child]:
    """Ask children to end (SIGTERM), and kill those that do not within the time.

    Returns:
        the children that had to be killed.
    """
    asked = [child for child in children if child.running]
    for child in asked:
        with suppress(ProcessLookupError):
            child.process.terminate()
    await _gone(asked, timeout_s)
    stubborn = [child for child in asked if child.running]
    for child in stubborn:
        # It leads a group of its own: with it go any processes that it started.
        with suppress(ProcessLookupError):
            os.killpg(child.process.pid, signal.SIGKILL)
    await _gone(stubborn, _KILL_WAIT_S)
    return stubborn


async def _gone(children: Sequence[Child], timeout_s: float) -> None:
    with suppress(TimeoutError):
        async with asyncio.timeout(timeout_s):
            await asyncio.gather(*(child.process.wait() for child in children))


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
