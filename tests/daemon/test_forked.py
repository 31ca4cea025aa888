"""A process for an object's methods: what comes back from it, and how it ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from vcl_companion.daemon.forked import Forked, ProcessLostError

LANES = {"one": 0, "other": 3}
WITHIN_S = 20.0


class UnportableError(Exception):
    """Cannot be made again from what it is pickled as."""

    def __init__(self, first: int, second: int) -> None:
        super().__init__(f"{first} and {second}")


def _no_memory() -> object:
    raise MemoryError


class TooMuch:
    """There is no memory for it where it arrives."""

    def __reduce__(self) -> tuple[Callable[[], object], tuple[()]]:
        return _no_memory, ()


class Shop:
    """What the tests have done elsewhere."""

    def __init__(self) -> None:
        self.calls = 0
        self.is_open = threading.Event()

    def pid(self) -> int:
        return os.getpid()

    def count(self) -> int:
        self.calls += 1
        return self.calls

    def doubled(self, values: NDArray[np.float64], text: str) -> tuple[NDArray[np.float64], str]:
        return 2.0 * values, text + text

    def fail(self) -> None:
        raise ValueError("no such luck")

    def fail_oddly(self) -> None:
        raise UnportableError(1, 2)

    def unportable(self) -> object:
        return threading.Lock()

    def wait(self) -> None:
        self.is_open.wait()

    def open(self) -> None:
        self.is_open.set()

    def niceness(self) -> int:
        return os.getpriority(os.PRIO_PROCESS, 0)

    def spin(self, for_s: float) -> None:
        until_s = time.process_time() + for_s
        while time.process_time() < until_s:
            pass

    def files(self) -> list[str]:
        found = []
        for number in os.listdir("/proc/self/fd"):
            try:
                found.append(os.readlink(f"/proc/self/fd/{number}"))
            except OSError:  # the listing's own
                continue
        return found

    def too_much(self) -> object:
        return TooMuch()

    def terminate_self(self) -> None:
        os.kill(os.getpid(), signal.SIGTERM)


@pytest.fixture
def shop() -> Iterator[Forked]:
    forked = Forked(Shop(), LANES)
    yield forked
    forked.end()


def test_methods_are_called_elsewhere_on_one_object(shop: Forked) -> None:
    assert shop.call("one", "pid").result(WITHIN_S) != os.getpid()
    assert [shop.call("one", "count").result(WITHIN_S) for _ in range(3)] == [1, 2, 3]


def test_large_and_empty_arrays_go_there_and_back(shop: Forked) -> None:
    for shape in ((3, 1_000_003), (0, 3), (1,)):
        values = np.random.default_rng(0).standard_normal(shape)
        twice, text = shop.call("one", "doubled", values, "ab").result(WITHIN_S)
        np.testing.assert_array_equal(twice, 2.0 * values)
        assert text == "abab"
    strided = np.arange(24.0).reshape(4, 6)[::2, ::3]
    np.testing.assert_array_equal(
        shop.call("one", "doubled", strided, "").result(WITHIN_S)[0], 2.0 * strided
    )


def test_lanes_do_not_wait_for_each_other_and_are_as_nice_as_told(shop: Forked) -> None:
    waiting = shop.call("one", "wait")
    ours = os.getpriority(os.PRIO_PROCESS, 0)
    assert shop.call("other", "niceness").result(WITHIN_S) == min(ours + 3, 19)
    assert not waiting.done()
    shop.call("other", "open").result(WITHIN_S)
    waiting.result(WITHIN_S)
    assert shop.call("one", "niceness").result(WITHIN_S) == ours


def test_failures_come_back_and_end_nothing(shop: Forked) -> None:
    with pytest.raises(ValueError, match="no such luck") as failure:
        shop.call("one", "fail").result(WITHIN_S)
    assert "in fail" in "".join(failure.value.__notes__)
    with pytest.raises(RuntimeError, match="UnportableError: 1 and 2"):
        shop.call("one", "fail_oddly").result(WITHIN_S)
    with pytest.raises(TypeError):
        shop.call("one", "unportable").result(WITHIN_S)
    with pytest.raises(TypeError):
        shop.call("one", "doubled", threading.Lock(), "").result(WITHIN_S)
    assert shop.call("one", "count").result(WITHIN_S) == 1


def test_who_asks_a_lost_process_is_told_so(shop: Forked) -> None:
    waiting = shop.call("one", "wait")
    os.kill(shop.call("other", "pid").result(WITHIN_S), signal.SIGKILL)
    with pytest.raises(ProcessLostError):
        waiting.result(WITHIN_S)
    with pytest.raises(ProcessLostError):
        shop.call("one", "count").result(WITHIN_S)


def test_who_cannot_read_what_comes_back_has_lost_the_process(shop: Forked) -> None:
    asked = shop.call("one", "wait"), shop.call("other", "too_much")
    for call in asked:
        with pytest.raises(ProcessLostError):
            call.result(WITHIN_S)


def test_it_leaves_signals_and_files_to_its_parent(shop: Forked, tmp_path: Path) -> None:
    with open(tmp_path / "log", "w"):
        forked = Forked(Shop(), LANES)
        assert not any("log" in file for file in forked.call("one", "files").result(WITHIN_S))
        forked.end()
    shop.call("one", "terminate_self").result(WITHIN_S)
    assert shop.call("one", "count").result(WITHIN_S) == 1


def test_it_ends_at_once_whatever_it_is_doing() -> None:
    forked = Forked(Shop(), LANES)
    pid = forked.call("other", "pid").result(WITHIN_S)
    forked.call("one", "wait")
    forked.end()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_what_it_takes_of_a_processor_is_its_own() -> None:
    forked = Forked(Shop(), LANES)
    forked.call("one", "spin", 0.2).result(WITHIN_S)
    assert 0.15 < forked.cpu_s() < WITHIN_S
    forked.end()
    assert forked.cpu_s() == 0.0


_DIES = """
import os, sys, time
from tests.daemon.test_forked import LANES, Shop
from vcl_companion.daemon.forked import Forked
forked = Forked(Shop(), LANES)
print(forked.call("one", "pid").result(20.0), flush=True)
forked.call("one", "wait")
time.sleep(60.0)
"""


def test_it_ends_with_a_parent_that_is_killed() -> None:
    root = Path(__file__).parents[2]
    parent = subprocess.Popen([sys.executable, "-c", _DIES], cwd=root, stdout=subprocess.PIPE)
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    # It holds the other end of our pipe: that is at its end when it has ended.
    assert parent.stdout.read() == b""
    until_s = time.monotonic() + WITHIN_S
    while Path(f"/proc/{pid}").exists() and time.monotonic() < until_s:
        if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
            break
        time.sleep(0.01)
    else:
        assert not Path(f"/proc/{pid}").exists()
    parent.stdout.close()
