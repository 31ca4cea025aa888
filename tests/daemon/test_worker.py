"""The thread for heavy work: in turn, failures told, and no hindrance at the end."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from concurrent.futures import CancelledError

import pytest

from vcl_companion.daemon.worker import Worker


def fail(reason: str) -> None:
    raise ValueError(reason)


def test_things_are_done_in_turn_in_a_thread_of_their_own() -> None:
    with Worker("vision") as worker:
        done: list[int] = []
        futures = [worker.submit(done.append, k) for k in range(20)]
        names = {worker.submit(lambda: threading.current_thread().name).result(5.0)}
        assert [future.result(5.0) for future in futures] == [None] * 20
    assert done == list(range(20))
    assert names == {"vision"}


@pytest.mark.skipif(sys.platform != "linux", reason="threads have no niceness of their own")
def test_one_thread_yields_to_the_others() -> None:
    def niceness() -> int:
        return os.getpriority(os.PRIO_PROCESS, 0)

    with Worker("vision") as frames, Worker("mapping", yields=5) as maps:
        ours = niceness()
        assert frames.submit(niceness).result(5.0) == ours
        assert maps.submit(niceness).result(5.0) == min(ours + 5, 19)
    assert niceness() == ours


def test_a_failure_is_told_and_the_next_thing_is_done() -> None:
    with Worker("vision") as worker:
        with pytest.raises(ValueError, match="fog"):
            worker.submit(fail, "fog").result(5.0)
        assert worker.submit(pow, 2, 3).result(5.0) == 8
    with pytest.raises(RuntimeError, match="shut down"):
        worker.submit(pow, 2, 3)


def test_what_waits_at_the_end_is_cancelled_when_it_is_asked_for() -> None:
    worker = Worker("mapping")
    began, go_on = threading.Event(), threading.Event()

    def hold() -> bool:
        began.set()
        return go_on.wait(5.0)

    running = worker.submit(hold)
    waiting = worker.submit(pow, 2, 3)
    assert began.wait(5.0)
    worker.shutdown(wait=False, cancel_futures=True)
    with pytest.raises(CancelledError):
        waiting.result(5.0)
    go_on.set()
    assert running.result(5.0)


@pytest.mark.parametrize("status", [0, 1])
def test_the_process_ends_though_something_is_still_being_done(status: int) -> None:
    code = (
        "import threading, cv2, numpy as np; from vcl_companion.daemon.worker import Worker\n"
        "began = threading.Event()\n"
        "image = np.random.default_rng(0).integers(0, 255, (1500, 1500), dtype=np.uint8)\n"
        "def work():\n"
        "    began.set()\n"
        "    while True: cv2.AKAZE_create().detectAndCompute(image, None)\n"
        "w = Worker('mapping'); w.submit(work); w.submit(work); began.wait()\n"
        f"w.shutdown(wait=False, cancel_futures=True); w.exit_status = {status}; print('over')"
    )
    ended = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60.0, check=False
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (status, "over\n", "")
