"""What a process has used: its own, not that of the one that started it."""

from __future__ import annotations

import subprocess
import sys
import time

import numpy as np

from vcl_companion.daemon.usage import cpu_s, peak_resident_mb

_TELL = "from vcl_companion.daemon.usage import peak_resident_mb as p; print(p())"


def test_a_small_process_of_a_large_one_tells_its_own_memory() -> None:
    large = np.ones(300 * 2**17)  # 300 MiB
    ours = peak_resident_mb()
    told = subprocess.run([sys.executable, "-c", _TELL], capture_output=True, check=True)
    assert large.nbytes / 2**20 < ours < 20_000.0
    assert 5.0 < float(told.stdout) < 100.0


def test_working_costs_processor_time_and_waiting_none() -> None:
    before_s, began_s = cpu_s(), time.process_time()
    np.linalg.inv(np.random.default_rng(0).standard_normal((600, 600)))
    assert cpu_s() - before_s > 0.0
    assert cpu_s() - before_s < time.process_time() - began_s + 0.1
