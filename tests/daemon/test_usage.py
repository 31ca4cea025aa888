"""What a process has used: its own, not that of the one that started it."""

from __future__ import annotations

import subprocess
import sys
import time

import numpy as np

from vcl_companion.daemon.usage import _unchanged_file_pages, cpu_s, forget_peak, peak_resident_mb

_TELL = "from vcl_companion.daemon.usage import peak_resident_mb as p; print(p())"

_GIVES_BACK = """
import numba, cv2, numpy as np
from pathlib import Path
from vcl_companion.daemon.usage import give_back_files

def resident():
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(line.split()[1] for line in lines if line.startswith("VmRSS"))

values = np.random.default_rng(0).standard_normal((64, 64))
numba.njit(lambda x: x + 1)(1)
found = [resident(), None, np.linalg.inv(values).sum(), None]
give_back_files()
found[1] = resident()
found[3] = np.linalg.inv(values).sum()
print(*found)
"""


def test_a_small_process_of_a_large_one_tells_its_own_memory() -> None:
    large = np.ones(300 * 2**17)  # 300 MiB
    ours = peak_resident_mb()
    told = subprocess.run([sys.executable, "-c", _TELL], capture_output=True, check=True)
    assert large.nbytes / 2**20 < ours < 20_000.0
    assert 5.0 < float(told.stdout) < 100.0


def test_a_peak_that_is_forgotten_is_not_told_again() -> None:
    large = np.ones(200 * 2**17)  # 200 MiB
    before_mb = peak_resident_mb()
    del large
    forget_peak()
    assert peak_resident_mb() < before_mb - 150.0


def test_working_costs_processor_time_and_waiting_none() -> None:
    before_s, began_s = cpu_s(), time.process_time()
    np.linalg.inv(np.random.default_rng(0).standard_normal((600, 600)))
    assert cpu_s() - before_s > 0.0
    assert cpu_s() - before_s < time.process_time() - began_s + 0.1


def test_what_was_given_back_is_read_again_when_it_is_needed() -> None:
    done = subprocess.run([sys.executable, "-c", _GIVES_BACK], capture_output=True, check=True)
    before_kb, after_kb, sum_before, sum_after = map(float, done.stdout.split())
    assert after_kb < before_kb - 20_000
    assert sum_before == sum_after


def test_only_files_that_nobody_changed_are_given_back() -> None:
    entry = """7f00{k}000-7f00{k}fff {rights} 00001000 08:01 12 {path}
Rss:                 {rss} kB
Shared_Dirty:          0 kB
Private_Dirty:         {dirty} kB
Anonymous:             {dirty} kB
VmFlags: rd mr mw me
"""
    maps = "".join(
        entry.format(k=k, rights=rights, path=path, rss=rss, dirty=dirty)
        for k, (rights, path, rss, dirty) in enumerate(
            [
                ("r-xp", "/usr/lib/libllvm.so", 9000, 0),
                ("r--p", "/usr/lib/libllvm.so", 9000, 4),
                ("rw-p", "/usr/lib/libllvm.so", 9000, 0),
                ("r-xp", "", 9000, 0),
                ("r-xp", "[vdso]", 9000, 0),
                ("r-xp", "/usr/lib/small.so", 200, 0),
                ("r--p", "/a path/with spaces.so", 300, 0),
            ]
        )
    )
    assert list(_unchanged_file_pages(maps)) == [
        (0x7F000000, 0x7F000FFF),
        (0x7F006000, 0x7F006FFF),
    ]
