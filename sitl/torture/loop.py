"""An event loop whose time is counted and whose executors work at once: the same run every time.

A daemon waits for seconds and works in threads; a payload that breaks it has to break
it again at the same place. Time passes when the owner says so, and what is handed to
an executor is done before the call returns. Whoever runs in it must not sleep: there is
nobody else to let time pass.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import Executor
from typing import TypeVar, TypeVarTuple

_T = TypeVar("_T")
_Ts = TypeVarTuple("_Ts")

_BEGINS_S = 1000.0


class CountedLoop(asyncio.SelectorEventLoop):
    """See the module.

    Attributes:
        now_s: what the time is; moved on by the owner, never back.
    """

    def __init__(self) -> None:
        self.now_s = _BEGINS_S
        super().__init__()

    def time(self) -> float:
        """Return the time as it was counted, s."""
        return self.now_s

    def run_in_executor(
        self, executor: Executor | None, func: Callable[[*_Ts], _T], *args: *_Ts
    ) -> asyncio.Future[_T]:
        """Do the work now, in this thread, whoever was to do it."""
        future: asyncio.Future[_T] = self.create_future()
        try:
            future.set_result(func(*args))
        except Exception as error:  # the future's owner is told, whatever it is
            future.set_exception(error)
        return future
