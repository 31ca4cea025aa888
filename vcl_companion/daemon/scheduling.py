"""Who runs first on the processors of this machine (Linux; elsewhere nothing changes)."""

from __future__ import annotations

import os
import sys
from contextlib import suppress


def run_before_others() -> bool:
    """Have the calling thread run before everything that is not real-time; new threads do not.

    Among ordinary threads one that becomes ready queues behind those of its processor, though
    another one may be making a map: frames that take 6 ms then took 20. It is the least of the
    real-time priorities, round-robin, and the kernel leaves the others a twentieth.

    Returns:
        Whether that is permitted: to root, or with an rtprio limit of 1 (``LimitRTPRIO=``).
    """
    if sys.platform == "linux":
        with suppress(OSError):
            policy = os.SCHED_RR | os.SCHED_RESET_ON_FORK
            os.sched_setscheduler(0, policy, os.sched_param(1))
            return True
    return False


def run_among_others() -> None:
    """Have the calling thread run among ordinary threads again."""
    if sys.platform == "linux":
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
