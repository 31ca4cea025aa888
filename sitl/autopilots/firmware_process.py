"""The process of a real firmware, in a folder of its own; it ends with us."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

from vcl_companion.errors import ConfigError

_LEASH = Path(__file__).parents[1] / "leash.py"
_ANSWERS_WITHIN_S = 20.0
_ENDS_WITHIN_S = 5.0


class FirmwareProcess:
    """A firmware that runs.

    Args:
        command: program and arguments.
        folder: where it runs; what it prints is kept beside it.
        environment: its own.
        stack: ends it.
    """

    def __init__(
        self,
        command: Sequence[str],
        folder: Path,
        environment: Mapping[str, str],
        stack: ExitStack,
    ) -> None:
        self._log = folder.with_name("firmware.log")
        leash = (sys.executable, "-I", "-S", str(_LEASH), str(os.getpid()))
        log = stack.enter_context(self._log.open("wb"))
        self._process = subprocess.Popen(
            (*leash, *command),
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
        )
        stack.callback(self._end)

    def still_there(self, asked_at_s: float) -> None:
        """Make sure that an answer may still come.

        Args:
            asked_at_s: monotonic clock when it was asked for, s.

        Raises:
            ConfigError: it has ended, or has not answered for too long.
        """
        if self._process.poll() is not None:
            raise ConfigError(self.obituary())
        if time.monotonic() - asked_at_s > _ANSWERS_WITHIN_S:
            raise ConfigError(f"the firmware does not answer; see {self._log}")

    def obituary(self) -> str:
        """Say in one line how it ended; one that hung up is waited for."""
        try:
            code = self._process.wait(_ENDS_WITHIN_S)
        except subprocess.TimeoutExpired:
            return f"the firmware has hung up its simulator; see {self._log}"
        return f"the firmware ended with exit code {code}; see {self._log}"

    def _end(self) -> None:
        self._process.terminate()
        try:
            self._process.wait(_ENDS_WITHIN_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
