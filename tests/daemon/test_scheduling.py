"""Threads that go before others, where the system lets them."""

from __future__ import annotations

import os
import sys
import threading

import pytest

from vcl_companion.daemon.scheduling import run_among_others, run_before_others

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="Linux only")


def policy() -> int:
    return os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK


def in_a_thread_of_its_own() -> list[object]:
    """What becomes of a thread that asks for it, of one that it starts, and of the first again."""
    found: list[object] = []

    def ask() -> None:
        found.append(run_before_others())
        found.append(policy())
        started = threading.Thread(target=lambda: found.append(policy()))
        started.start()
        started.join()
        run_among_others()
        found.append(policy())

    asking = threading.Thread(target=ask)
    asking.start()
    asking.join()
    return found


def test_who_may_goes_before_others_and_nobody_else() -> None:
    before = policy()
    may, asked, started, again = in_a_thread_of_its_own()
    assert asked == (os.SCHED_RR if may else before)
    assert started == again == os.SCHED_OTHER
    assert policy() == before


def test_root_may() -> None:
    if os.geteuid() != 0:
        pytest.skip("only root may for sure")
    may, asked, *_ = in_a_thread_of_its_own()
    assert (may, asked) == (True, os.SCHED_RR)
