"""Running the daemon's parts in a test: to a bound, and in a time that can be moved on."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Coroutine
from typing import Any

# Maps are made by threads that are nicer than everything: beside flights of other tests what takes
# a tenth of a second alone may take twenty.
BOUND_S = 90.0


class HurriedLoop(asyncio.SelectorEventLoop):
    """An event loop whose timers can be hurried on; its sockets are as ever."""

    def __init__(self) -> None:
        super().__init__()
        self._ahead_s = 0.0
        self.bound: asyncio.Timeout | None = None

    def time(self) -> float:
        return super().time() + self._ahead_s

    def hurry(self, seconds: float) -> None:
        """Have everything happen that is due within so many seconds."""
        self._ahead_s += seconds
        if self.bound is not None:  # the test itself has as long as before
            self.bound.reschedule(self.time() + BOUND_S)


def running_loop() -> HurriedLoop:
    """The running test's loop."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, HurriedLoop)
    return loop


def hurry(seconds: float) -> None:
    """Move the running test's loop on."""
    running_loop().hurry(seconds)


def run(scenario: Coroutine[Any, Any, None]) -> None:
    """Run a test's coroutine, bounded, in a loop that can be hurried."""

    async def bounded() -> None:
        async with asyncio.timeout(BOUND_S) as bound:
            running_loop().bound = bound
            await scenario

    with asyncio.Runner(loop_factory=HurriedLoop) as runner:
        runner.run(bounded())


async def until(condition: Callable[[], bool]) -> None:
    """Look again and again whether something has come true; the test's bound ends it."""
    while not condition():
        await asyncio.sleep(0.005)


@contextlib.asynccontextmanager
async def beside(*work: Coroutine[Any, Any, None]) -> AsyncIterator[None]:
    """Run coroutines beside the block; the failure of one is the test's, at once."""
    async with asyncio.TaskGroup() as group:
        tasks = [group.create_task(coroutine) for coroutine in work]
        yield
        for task in tasks:
            task.cancel()


async def passes(seconds: float) -> None:
    """Let time pass in small steps, in which everybody says what there is to say."""
    for _ in range(round(seconds / 0.25)):
        hurry(0.25)
        for _ in range(3):
            await asyncio.sleep(0.002)


async def passes_until(condition: Callable[[], bool], at_most_s: float = 60.0) -> None:
    """Let time pass until something has come true."""
    for _ in range(round(at_most_s / 0.25)):
        if condition():
            return
        await passes(0.25)
    assert condition()


async def computed(condition: Callable[[], bool]) -> None:
    """Wait for what takes a processor's time, however busy that is, to a bound."""
    for _ in range(900):
        if condition():
            return
        hurry(0.0)  # the test's own bound counts from here
        await asyncio.sleep(0.1)
    assert condition()
