"""Ctrl-C of what runs in a counted loop or in worker processes: one line, and nothing is left."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

TIMEOUT_S = 60.0
# After so much processor time it is in the middle of the drones' tasks.
# What the drones log is none of the loop's: with how fast the machine is, they get further.
PROGRAM = """
import logging
import signal
from sitl.scale.swarm import ScaleTimes, run_swarm
from sitl.torture.session import run_session
from vcl_companion.wire.warm_up import warm_up

logging.getLogger("vcl_companion").addHandler(logging.NullHandler())
warm_up()
signal.signal(signal.SIGVTALRM, lambda *_: signal.raise_signal(signal.SIGINT))
signal.setitimer(signal.ITIMER_VIRTUAL, {after_s})
try:
    {call}
except KeyboardInterrupt:
    print("interrupted")
"""
SESSION = "run_session(0, 0, 1_000_000, 1_000_000)"
SWARM = "run_swarm(10, 0.1, 0, ScaleTimes(rest_s=100_000.0), lambda phase: None)"


@contextmanager
def started(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Start Python as a terminal would: in a group of its own, and Ctrl-C is not ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    with subprocess.Popen(
        [sys.executable, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    ) as process:
        signal.signal(signal.SIGINT, before)
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize("call", [SESSION, SWARM])
@pytest.mark.parametrize("after_s", [1.0, 1.37])
def test_no_task_is_left_in_a_loop_that_is_interrupted(call: str, after_s: float) -> None:
    with started("-c", PROGRAM.format(call=call, after_s=after_s)) as process:
        said, _ = process.communicate(timeout=TIMEOUT_S)
    assert said == "interrupted\n"


def test_workers_say_nothing_on_ctrl_c_and_end_at_once(tmp_path: Path) -> None:
    torture = ("torture", "--processes", "2", "--payloads", "1000000", "--out", str(tmp_path))
    with started("-m", "sitl", *torture) as process:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
        # The two, and who tidies up after them.
        while len(pids := children.read_text().split()) < 3:
            assert process.poll() is None
        pidfds = [os.pidfd_open(int(pid)) for pid in pids]
        while sum("numpy" in Path(f"/proc/{pid}/maps").read_text() for pid in pids) < 2:
            assert process.poll() is None  # they are importing
        os.killpg(process.pid, signal.SIGINT)
        said, _ = process.communicate(timeout=TIMEOUT_S)
    assert said == "sitl: interrupted\n"
    assert process.returncode == 130
    for pidfd in pidfds:
        assert select.select([pidfd], [], [], 10.0)[0], "a worker still runs"
        os.close(pidfd)


def test_a_flight_that_is_ended_twice_at_once_ends_without_a_traceback(tmp_path: Path) -> None:
    """As `timeout` does it: the process, and then its group."""
    with started("-m", "sitl", "fly", "demo", "--out", str(tmp_path / "out")) as process:
        assert process.stdout is not None
        said = ""
        while "making the first map" not in said:
            assert process.poll() is None
            said += process.stdout.readline()
        for _ in range(2):
            os.killpg(process.pid, signal.SIGTERM)
        said, _ = process.communicate(timeout=TIMEOUT_S)
    assert "Traceback" not in said
    assert process.returncode == 128 + signal.SIGTERM
