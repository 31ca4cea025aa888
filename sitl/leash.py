"""Run a command that the kernel ends when whoever started it is gone.

``python leash.py PARENT_PID PROGRAM ARGUMENT...`` becomes PROGRAM. A script of its own
rather than a ``preexec_fn``, which is not safe in a process with threads.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1


def main(arguments: list[str]) -> None:
    """Tie this process to its parent, then become the command; Linux only, elsewhere untied."""
    parent, program = int(arguments[0]), arguments[1:]
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)
        # The parent may have died before the line above; then no signal will come.
        if os.getppid() != parent:
            sys.exit(f"leash: process {parent} is gone")
    os.execv(program[0], program)


if __name__ == "__main__":
    main(sys.argv[1:])
