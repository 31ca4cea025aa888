"""How this computer is, as its kernel says (Linux): for ONBOARD_COMPUTER_STATUS."""

from __future__ import annotations

import shutil
import time
from contextlib import suppress
from pathlib import Path

from vcl_companion.daemon.usage import kilobytes
from vcl_companion.links.own_messages import ComputerStatus

_PROC, _THERMAL = Path("/proc"), Path("/sys/class/thermal")
_MIB = 1 << 20
# What zones of a processor are called: Raspberry Pi and Jetson, other boards, PCs.
_PROCESSORS = ("cpu", "soc", "x86_pkg")
_NO_SUCH = (OSError, ValueError, KeyError, IndexError)


class OnboardComputer:
    """Looks at the computer; takes a millisecond or as long as its disk, any one thread may.

    Args:
        directory: on the file system whose space counts.
        proc: where the kernel tells of processes.
        thermal: where it tells temperatures.
    """

    def __init__(self, directory: Path, proc: Path = _PROC, thermal: Path = _THERMAL) -> None:
        self._directory = directory
        self._proc = proc
        self._thermal = thermal
        self._before = self._ticks()

    def status(self) -> ComputerStatus:
        """Return how it is now; the load is that since the last time this was asked."""
        uptime_ms = 0
        with suppress(*_NO_SUCH):
            said = (self._proc / "uptime").read_text(encoding="ascii")
            uptime_ms = round(1000 * float(said.split()[0]))
        ram_mib = ram_used_mib = disk_mib = disk_used_mib = None
        with suppress(*_NO_SUCH):
            memory = kilobytes("meminfo", self._proc)
            ram_mib = memory["MemTotal:"] // 1024
            ram_used_mib = (memory["MemTotal:"] - memory["MemAvailable:"]) // 1024
        with suppress(OSError):
            disk = shutil.disk_usage(self._directory)
            disk_mib, disk_used_mib = disk.total // _MIB, disk.used // _MIB
        return ComputerStatus(
            time.time_ns() // 1000,
            uptime_ms,
            self._loads_percent(),
            ram_used_mib,
            ram_mib,
            disk_used_mib,
            disk_mib,
            self._degrees(),
        )

    def _loads_percent(self) -> tuple[int, ...]:
        before, self._before = self._before, self._ticks()
        loads = []
        for core, (idle, total) in self._before.items():
            idle_before, total_before = before.get(core, (0, 0))
            passed = total - total_before
            # Counters of idle time may go back (proc(5)).
            rest = min(max(idle - idle_before, 0), passed)
            loads.append(round(100 * (1 - rest / passed)) if passed > 0 else 0)
        return tuple(loads)

    def _ticks(self) -> dict[str, tuple[int, int]]:
        """Return, of each core, the time that it had nothing to do, and all of it, in ticks."""
        cores = {}
        with suppress(*_NO_SUCH):
            for line in (self._proc / "stat").read_text(encoding="ascii").splitlines():
                name, *fields = line.split()
                if name.startswith("cpu") and name != "cpu":
                    # user nice system idle iowait irq softirq steal; guests are in the first two.
                    spent = [int(field) for field in fields[:8]]
                    cores[name] = (spent[3] + spent[4], sum(spent))
        return cores

    def _degrees(self) -> tuple[int, ...]:
        degrees = []
        for zone in sorted(self._thermal.glob("thermal_zone*")):
            with suppress(*_NO_SUCH):
                kind = (zone / "type").read_text(encoding="ascii").lower()
                if any(name in kind for name in _PROCESSORS):
                    degrees.append(round(int((zone / "temp").read_text(encoding="ascii")) / 1000))
        return tuple(degrees)
