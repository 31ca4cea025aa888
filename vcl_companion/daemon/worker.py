"""A thread for heavy work that does not hold the process when the service ends."""

from __future__ import annotations

import atexit
import os
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import Any, ParamSpec, TypeVar

_P = ParamSpec("_P")
_T = TypeVar("_T")
_Work = tuple["Future[Any]", Callable[[], Any]]


class Worker(Executor):
    """Does one thing after the other, in one thread.

    The standard library's pool makes the interpreter wait for what its threads
    still do; an update of a map takes seconds, and who ends the service has
    only so much patience. Nor may the interpreter take such a thread down with
    it: native code under way would abort. So a process whose worker still works
    ends on the spot, when everything else has been put in order.

    Args:
        name: of the thread.
        yields: by so much it is nicer than the process, where the system can tell
            threads apart (Linux): everybody's frames go before anybody's maps.

    Attributes:
        exit_status: of a process that ends so.
    """

    def __init__(self, name: str, yields: int = 0) -> None:
        self._yields = yields
        self._queue: SimpleQueue[_Work | None] = SimpleQueue()
        self._is_shut = False
        self._is_busy = False
        self.exit_status = 1
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def submit(self, fn: Callable[_P, _T], /, *args: _P.args, **kwargs: _P.kwargs) -> Future[_T]:
        """Have something done when its turn comes.

        Raises:
            RuntimeError: it is shut down.
        """
        if self._is_shut:
            raise RuntimeError("the worker is shut down")
        future: Future[_T] = Future()
        self._queue.put((future, lambda: fn(*args, **kwargs)))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Take nothing more; what waits is cancelled, or done first."""
        self._is_shut = True
        atexit.register(self._end_if_busy)
        while cancel_futures:
            try:
                work = self._queue.get_nowait()
            except Empty:
                break
            if work is not None:
                work[0].cancel()
        self._queue.put(None)
        if wait:
            self._thread.join()

    def _run(self) -> None:
        if self._yields and sys.platform == "linux":
            # A sandbox may forbid it; the work is done all the same.
            with suppress(OSError):
                niceness = os.getpriority(os.PRIO_PROCESS, 0) + self._yields
                os.setpriority(os.PRIO_PROCESS, 0, niceness)
        while (work := self._queue.get()) is not None:
            future, do = work
            if not future.set_running_or_notify_cancel():
                continue
            self._is_busy = True
            try:
                result = do()
            except BaseException as error:  # the future's owner is told, whatever it is
                future.set_exception(error)
            else:
                future.set_result(result)
            self._is_busy = False
            del work, future, do

    def _end_if_busy(self) -> None:
        if self._is_busy:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(self.exit_status)
