"""Whose processor time it is: an event loop that counts what runs for each drone.

Everything that a drone's tasks, timers and callbacks do runs in a context of its own, which
they hand on to what they begin. So does what its datagrams cause.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from contextvars import Context, ContextVar
from typing import TypeVarTuple

from sitl.counted_loop import SkippingLoop

_Ts = TypeVarTuple("_Ts")


class Meter:
    """Processor time that was spent for one drone.

    Attributes:
        spent_s: so far.
    """

    def __init__(self) -> None:
        self.spent_s = 0.0

    def run(self, callback: Callable[[*_Ts], object], *args: *_Ts) -> None:
        """Call it, and count the time of this thread."""
        began_s = time.thread_time()
        try:
            callback(*args)
        finally:
            self.spent_s += time.thread_time() - began_s


_meter: ContextVar[Meter | None] = ContextVar("_meter", default=None)


def metered(meter: Meter) -> Context:
    """Return a context for what one drone does."""
    context = Context()
    context.run(_meter.set, meter)
    return context


class MeteredLoop(SkippingLoop):
    """A loop that skips time, and counts what is spent in every context of ``metered``."""

    def call_soon(
        self, callback: Callable[[*_Ts], object], *args: *_Ts, context: Context | None = None
    ) -> asyncio.Handle:
        """Have something called at the next turn."""
        meter = _meter_of(context)
        if meter is None:
            return super().call_soon(callback, *args, context=context)
        return super().call_soon(meter.run, callback, *args, context=context)

    def call_at(
        self,
        when: float,
        callback: Callable[[*_Ts], object],
        *args: *_Ts,
        context: Context | None = None,
    ) -> asyncio.TimerHandle:
        """Have something called at an instant of the loop's time."""
        meter = _meter_of(context)
        if meter is None:
            return super().call_at(when, callback, *args, context=context)
        return super().call_at(when, meter.run, callback, *args, context=context)


def _meter_of(context: Context | None) -> Meter | None:
    return _meter.get() if context is None else context.get(_meter)
