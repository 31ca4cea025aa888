"""How a computer is, by files as kernels write them."""

from pathlib import Path

import pytest

from tests.links import wire
from vcl_companion.daemon.onboard_computer import OnboardComputer
from vcl_companion.links.counters import LinkTally
from vcl_companion.links.mavlink import Codec
from vcl_companion.links.own_messages import ComputerStatus, computer_status


def write_stat(proc: Path, *cores: tuple[int, ...]) -> None:
    lines = ["cpu  1 2 3 4 5 6 7 8 0 0"]
    lines += [f"cpu{i} " + " ".join(map(str, ticks)) for i, ticks in enumerate(cores)]
    (proc / "stat").write_text("\n".join([*lines, "intr 1 2 3", "ctxt 5"]) + "\n")


@pytest.fixture
def proc(tmp_path: Path) -> Path:
    proc = tmp_path / "proc"
    proc.mkdir()
    write_stat(proc, (100, 0, 50, 1000, 10, 0, 5, 0, 7, 0), (0, 0, 0, 500, 0, 0, 0, 0, 0, 0))
    (proc / "uptime").write_text("12345.67 20000.00\n")
    (proc / "meminfo").write_text(
        "MemTotal:        8388608 kB\nMemFree: 1024 kB\nMemAvailable:    6291456 kB\nHugePages: 0\n"
    )
    return proc


def test_load_is_that_of_each_core_since_the_last_look(tmp_path: Path, proc: Path) -> None:
    computer = OnboardComputer(tmp_path, proc, tmp_path / "none")
    # Of 100 ticks: 30 user, 10 system, 55 idle, 5 waiting for a disk; and of 200 all idle.
    write_stat(proc, (130, 0, 60, 1055, 15, 0, 5, 0, 9, 0), (0, 0, 0, 700, 0, 0, 0, 0, 0, 0))
    assert computer.status().cores_percent == (40, 0)
    # Nothing has passed, and a counter that goes back.
    assert computer.status().cores_percent == (0, 0)
    write_stat(proc, (230, 0, 60, 1055, 10, 0, 5, 0, 9, 0), (0, 0, 0, 600, 0, 0, 0, 0, 0, 0))
    assert computer.status().cores_percent == (100, 0)


def test_memory_disk_time_and_heat_are_those_of_the_computer(tmp_path: Path, proc: Path) -> None:
    thermal = tmp_path / "thermal"
    for i, (kind, temperature) in enumerate(
        [("cpu-thermal", "61234"), ("gpu-thermal", "70000"), ("soc0-thermal", "broken"),
         ("x86_pkg_temp", "-5600")]
    ):  # fmt: skip
        zone = thermal / f"thermal_zone{i}"
        zone.mkdir(parents=True)
        (zone / "type").write_text(kind + "\n")
        (zone / "temp").write_text(temperature + "\n")
    status = OnboardComputer(tmp_path, proc, thermal).status()
    assert status.uptime_ms == 12_345_670
    assert (status.ram_mib, status.ram_used_mib) == (8192, 2048)
    assert status.cores_deg == (61, -6)
    assert status.disk_mib is not None
    assert status.disk_used_mib is not None
    assert 0 < status.disk_used_mib <= status.disk_mib


def test_what_a_kernel_does_not_tell_is_told_as_unknown(tmp_path: Path) -> None:
    nowhere = tmp_path / "nowhere"
    status = OnboardComputer(nowhere, nowhere, nowhere).status()
    assert (status.cores_percent, status.cores_deg) == ((), ())
    assert status.ram_mib is status.ram_used_mib is status.disk_mib is None
    (seen,) = wire.read(Codec(1, 197, LinkTally()).frame(computer_status(status)))
    assert seen.fields[2:4] == (0xFFFFFFFF, 0xFFFFFFFF)
    assert seen.fields[-9:] == (127,) * 9


def test_numbers_that_do_not_fit_are_the_nearest_that_do() -> None:
    status = ComputerStatus(
        1, 1 << 40, (101, -1, *[50] * 20), 1 << 40, 1 << 40, 0, 1 << 40, (500, -500, *[40] * 20)
    )
    (seen,) = wire.read(Codec(1, 197, LinkTally()).frame(computer_status(status)))
    uptime, ram_used, ram = seen.fields[1:4]
    assert (uptime, ram_used, ram) == (0xFFFFFFFF, 0xFFFFFFFE, 0xFFFFFFFE)
    assert seen.fields[-8:] == (126, -128, *[40] * 6)
    assert seen.fields[51:59] == (100, 0, *[50] * 6)
