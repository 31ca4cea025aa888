"""An event loop whose time is counted and whose executors work at once: the same run every time.

A daemon waits for seconds and works in threads; a payload that breaks it has to break
it again at the same place. Time passes when the owner says so, and what is handed to
an executor is done before the call returns. In a ``CountedLoop`` nobody must sleep: there
is nobody else to let time pass. In a ``SkippingLoop`` time passes when everybody sleeps, at
once, to the next instant at which somebody is to be woken.
"""

from __future__ import annotations

import asyncio
import selectors
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

    def __init__(self, selector: selectors.BaseSelector | None = None) -> None:
        self.now_s = _BEGINS_S
        super().__init__(selector)

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


class SkippingLoop(CountedLoop):
    """A counted loop that never waits: it skips to the next timer; no socket is of use in it."""

    def __init__(self) -> None:
        super().__init__(_SkippingSelector(self._skip))

    def _skip(self, for_s: float) -> None:
        self.now_s += for_s


class _SkippingSelector(selectors.DefaultSelector):
    """Looks at files without waiting for them, and says how long it would have waited."""

    def __init__(self, skip: Callable[[float], None]) -> None:
        super().__init__()
        self._skip = skip

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Return which files are ready now.

        Raises:
            RuntimeError: nobody is ever to be woken again.
        """
        if timeout is None:
            raise RuntimeError("everybody waits, and nobody is to be woken")
        self._skip(max(timeout, 0.0))
        return super().select(0)
