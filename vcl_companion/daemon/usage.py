"""What this process has used of the machine, for the log's last line."""

from __future__ import annotations

import resource
from pathlib import Path

_STATUS = Path("/proc/self/status")


def cpu_s() -> float:
    """Return the processor time of all threads so far."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def peak_resident_mb() -> float:
    """Return the most memory that was resident, MiB.

    Not ``ru_maxrss``, where the kernel tells: that one survives exec, so that a
    small process started by a large one claims the large one's.
    """
    try:
        for line in _STATUS.read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    except (OSError, ValueError):
        pass
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
