"""``python -m sitl torture``: sessions in several processes, what they come to, and where it is.

``report.json`` holds every outcome with its count, ``failures/INDEX.txt`` what went wrong
at a payload, ``INDEX.bin`` its bytes, ``INDEX.blob`` the blob that it completed.
"""

from __future__ import annotations

import faulthandler
import json
import os
import sys
import time
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import cv2
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar

from sitl.result_folder import result_folder
from sitl.torture.report import TortureOptions, is_good, report_of, show_torture
from sitl.torture.session import Failure, SessionResult, run_session
from sitl.torture.workers import deaf_to_ctrl_c, workers
from vcl_companion.daemon.usage import share_freed
from vcl_companion.wire.warm_up import warm_up

Progress = Callable[[int, int], None]

_MOST_KEPT = 100


def torture(out: Path, options: TortureOptions, progress: Progress) -> dict[str, Any]:
    """Feed payloads to drones, and write ``report.json`` and the failures into a folder.

    Args:
        out: made if absent.
        options: how much.
        progress: told how many payloads are done, of how many.

    Returns:
        The report.

    Raises:
        ConfigError: the folder cannot be written.
    """
    _prepare(out)
    began_s = time.monotonic()
    results = []
    done = 0
    with closing(_sessions(options)) as sessions:
        for result in sessions:
            results.append(result)
            done += result.payloads
            progress(done, options.payloads)
            _write_failures(out, result.failures)
    wall_s = time.monotonic() - began_s
    report = report_of(options, sorted(results, key=lambda r: r.session), wall_s)
    text = json.dumps(report, indent=1, ensure_ascii=False, allow_nan=False)
    (out / "report.json").write_text(text + "\n", encoding="utf-8")
    return report


def torture_once_more(out: Path, options: TortureOptions, index: int) -> list[Failure]:
    """Feed one session again up to a payload, and return what fails at that one.

    Raises:
        ConfigError: the folder cannot be written.
    """
    _prepare(out)
    _warm_up()
    session, before = divmod(index, options.session)
    result = run_session(options.seed, session, options.session, before + 1, only_last=True)
    _write_failures(out, result.failures)
    return result.failures


def run_torture(out: Path, options: TortureOptions, only: int | None, console: Console) -> bool:
    """Run and show it all, or the session of one payload up to it; return whether it went well.

    Raises:
        ConfigError: the folder cannot be written.
    """
    if only is not None:
        failures = torture_once_more(out, options, only)
        for failure in failures:
            _print(console, failure.traceback)
        kept = out / "failures" / f"{only}.bin"
        _print(console, f"FAILED: {kept}" if failures else f"payload {only} does not fail")
        return not failures
    with _shown(console) as progress:
        report = torture(out, options, progress)
    show_torture(console, report, out)
    return is_good(report)


@contextmanager
def _shown(console: Console) -> Iterator[Progress]:
    """Show progress as a bar on a terminal, and not at all elsewhere."""
    if not console.is_terminal:
        yield lambda done, total: None
        return
    with Bar(BarColumn(bar_width=40), MofNCompleteColumn(), TextColumn("payloads"),
             TimeElapsedColumn(), console=console, transient=True) as bar:  # fmt: skip
        task = bar.add_task("", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _print(console: Console, text: str) -> None:
    console.print(text, markup=False, highlight=False, soft_wrap=True)


def _sessions(options: TortureOptions) -> Generator[SessionResult, None, None]:
    """Yield the sessions of a run as they are over."""
    n = -(-options.payloads // options.session)
    lengths = [options.session] * (n - 1) + [options.payloads - (n - 1) * options.session]
    processes = min(options.processes or os.cpu_count() or 1, n)
    if processes == 1:
        _warm_up()
        for session, payloads in enumerate(lengths):
            yield run_session(options.seed, session, options.session, payloads)
        return
    with workers(processes, _warm_up) as pool:
        with deaf_to_ctrl_c():
            waiting = [
                pool.submit(run_session, options.seed, session, options.session, payloads)
                for session, payloads in enumerate(lengths)
            ]
        numbers = {future: session for session, future in enumerate(waiting)}
        for future in as_completed(waiting):
            try:
                yield future.result()
            except BrokenProcessPool as error:
                yield _died(numbers[future], options.session, error)


def _died(session: int, length: int, error: BrokenProcessPool) -> SessionResult:
    """Return what is known of a session whose process, or another one beside it, crashed."""
    what = "a process crashed in this session or in one beside it; see what it printed"
    failure = Failure(session * length, what, str(error), b"")
    return SessionResult(session, pid=-1, failures=[failure], n_failures=1)


def _warm_up() -> None:
    """Do what a daemon does before it hears anybody: its compiled code is no growth."""
    if not faulthandler.is_enabled() and sys.__stderr__ is not None:
        faulthandler.enable(sys.__stderr__)
    cv2.setNumThreads(1)
    share_freed()
    warm_up()


def _prepare(out: Path) -> None:
    with result_folder(out, ("report.json", "failures")):
        (out / "failures").mkdir(exist_ok=True)
        for old in (out / "failures").iterdir():
            if old.suffix in (".txt", ".bin", ".blob"):
                old.unlink()


def _write_failures(out: Path, failures: list[Failure]) -> None:
    folder = out / "failures"
    for failure in failures:
        if len(list(folder.glob("*.txt"))) >= _MOST_KEPT:
            return
        (folder / f"{failure.index}.txt").write_text(failure.traceback, encoding="utf-8")
        (folder / f"{failure.index}.bin").write_bytes(failure.datagram)
        if failure.blob:
            (folder / f"{failure.index}.blob").write_bytes(failure.blob)
