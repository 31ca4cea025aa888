"""Worker processes: Ctrl-C is not theirs, and none of them outlives a run that is broken off."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager


@contextmanager
def workers(n: int, initializer: Callable[[], None]) -> Iterator[ProcessPoolExecutor]:
    """Have worker processes; when the block is left by an exception they are ended at once.

    Args:
        n: at most so many.
        initializer: called in each of them first.
    """
    others = multiprocessing.active_children()
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(n, context, initializer=initializer) as pool:
        try:
            yield pool
        except BaseException:
            for child in multiprocessing.active_children():
                if child not in others:
                    child.terminate()
            pool.shutdown(cancel_futures=True)
            raise


@contextmanager
def deaf_to_ctrl_c() -> Iterator[None]:
    """Have all processes that are started in the block blind to SIGINT; ours comes after it.

    A terminal sends it to all of them. One that is still importing could do no better than
    print where it was; what is blocked here is blocked there from the first instruction on.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
