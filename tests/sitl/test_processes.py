"""Real processes, started, watched and ended; each waits for an event, none for a while."""

import asyncio
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Coroutine
from pathlib import Path
from types import SimpleNamespace

import pytest

from sitl.processes import Child, FlightError, end_children, start_child, unless_one_ends

LONG = "import time; print('ready', flush=True); time.sleep(600)"
DEAF = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); " + LONG


def soon(work: Coroutine[None, None, None]) -> None:
    async def bounded() -> None:
        async with asyncio.timeout(20.0):
            await work

    asyncio.run(bounded())


async def started(folder: Path, name: str, code: str) -> Child:
    """Start a Python process and, when it says that it is ready, wait for that."""
    child = await start_child(
        name,
        (sys.executable, "-c", code),
        log_prefix=folder / name,
        environment=os.environ,
        piped=True,
    )
    assert child.process.stdout is not None
    if "ready" in code:
        assert await child.process.stdout.readline() == b"ready\n"
    return child


async def forever() -> None:
    await asyncio.Event().wait()


async def end_of(pidfd: int) -> None:
    """Wait until the process behind a pidfd has ended."""
    loop, ended = asyncio.get_running_loop(), asyncio.Event()
    loop.add_reader(pidfd, ended.set)
    await ended.wait()
    loop.remove_reader(pidfd)
    os.close(pidfd)


def test_a_process_that_ends_is_named_with_its_last_words(tmp_path: Path) -> None:
    async def work() -> None:
        quiet = await started(tmp_path, "quiet", LONG)
        code = (
            "import sys; sys.stderr.write('Traceback\\n  ...\\nlens fell off\\n\\n'); sys.exit(3)"
        )
        crashed = await started(tmp_path, "daemon of mav1", code)
        with pytest.raises(FlightError) as raised:
            await unless_one_ends([quiet, crashed], forever())
        assert str(raised.value) == "daemon of mav1 ended with exit code 3: lens fell off"
        await end_children([quiet, crashed], 10.0)
        assert quiet.process.returncode == -signal.SIGTERM

    soon(work())


def test_a_killed_process_says_by_what(tmp_path: Path) -> None:
    async def work() -> None:
        child = await started(tmp_path, "daemon", LONG)
        child.process.kill()
        with pytest.raises(FlightError, match="daemon was ended by SIGKILL without a word"):
            await unless_one_ends([child], forever())

    soon(work())


def test_who_had_no_room_for_a_last_word_is_known_by_the_full_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def work() -> None:
        child = await started(tmp_path, "daemon", "raise SystemExit(1)")
        monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=0))
        with pytest.raises(FlightError, match=r"daemon ended with exit code 1: the disk of .* is "):
            await unless_one_ends([child], forever())

    soon(work())


def test_even_a_clean_end_is_an_end_too_soon(tmp_path: Path) -> None:
    async def work() -> None:
        child = await started(tmp_path, "daemon", "pass")
        with pytest.raises(FlightError, match="daemon ended with exit code 0 without a word"):
            await unless_one_ends([child], forever())

    soon(work())


def test_a_process_is_blamed_for_the_broken_pipe_that_it_caused(tmp_path: Path) -> None:
    async def work() -> None:
        child = await started(tmp_path, "daemon", "import sys; sys.exit('out of film')")

        async def talk() -> None:
            raise FlightError("the stream is closed")

        with pytest.raises(FlightError, match="daemon ended with exit code 1: out of film"):
            await unless_one_ends([child], talk())

    soon(work())


def test_work_is_done_and_its_own_errors_are_its_own(tmp_path: Path) -> None:
    async def work() -> None:
        child = await started(tmp_path, "daemon", LONG)

        async def answer() -> int:
            return 42

        async def fail() -> None:
            raise FlightError("no answer")

        assert await unless_one_ends([child], answer()) == 42
        with pytest.raises(FlightError, match=r"^no answer$"):
            await unless_one_ends([child], fail())
        assert child.running
        await end_children([child], 10.0)

    soon(work())


def test_who_does_not_end_when_asked_is_killed_with_its_own_children(tmp_path: Path) -> None:
    code = (
        "import subprocess, sys, signal; signal.signal(signal.SIGTERM, signal.SIG_IGN);"
        "p = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)']);"
        "print('ready', flush=True); print(p.pid, flush=True); p.wait()"
    )

    async def work() -> None:
        deaf = await started(tmp_path, "deaf", code)
        willing = await started(tmp_path, "willing", LONG)
        assert deaf.process.stdout is not None
        grandchild = os.pidfd_open(int(await deaf.process.stdout.readline()))
        assert await end_children([deaf, willing], 0.3) == [deaf]
        assert deaf.process.returncode == -signal.SIGKILL
        assert willing.process.returncode == -signal.SIGTERM
        await end_of(grandchild)
        assert await end_children([deaf, willing], 0.3) == []

    soon(work())


def test_no_process_outlives_a_harness_that_is_killed(tmp_path: Path) -> None:
    """SIGKILL leaves no time to clean up: the kernel does it."""
    harness = (
        "import asyncio, sys\n"
        "from pathlib import Path\n"
        "from tests.sitl.test_processes import DEAF, started\n"
        "async def main():\n"
        f"    child = await started(Path({str(tmp_path)!r}), 'child', DEAF)\n"
        "    print(child.process.pid, flush=True)\n"
        "    await asyncio.Event().wait()\n"
        "asyncio.run(main())\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", harness],
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[2],
    ) as parent:
        assert parent.stdout is not None
        child = os.pidfd_open(int(parent.stdout.readline()))
        parent.kill()
    soon(end_of(child))


def test_a_child_is_in_a_group_of_its_own_in_our_session(tmp_path: Path) -> None:
    """A Ctrl-C on the terminal goes to us, and we end the children in order.

    Of a session of its own its niceness would count among its own threads only (autogroup).
    """

    async def work() -> None:
        child = await started(tmp_path, "child", LONG)
        assert os.getpgid(child.process.pid) == child.process.pid != os.getpgid(0)
        assert os.getsid(child.process.pid) == os.getsid(0)
        await end_children([child], 10.0)

    soon(work())
