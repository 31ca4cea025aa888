"""Memory of two processes: what they share counts once, and the most at one time is told."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from vcl_companion.daemon.forked import Forked
from vcl_companion.daemon.memory_watch import MemoryWatch
from vcl_companion.daemon.shared_arrays import shared

WITHIN_S = 20.0
MIB = 2**17  # of float64


class Shop:
    """Takes memory elsewhere."""

    def __init__(self) -> None:
        self._kept: list[NDArray[np.float64]] = []

    def keep(self, mebibytes: int) -> None:
        self._kept.append(np.ones(mebibytes * MIB))

    def let_go(self) -> None:
        self._kept.clear()

    def make_shared(self, mebibytes: int) -> NDArray[np.float64]:
        made = shared(np.ones(mebibytes * MIB))
        self._kept.append(made)
        assert made.sum() == mebibytes * MIB  # looked at, so that it is resident
        return made


@pytest.fixture
def shop() -> Iterator[Forked]:
    forked = Forked(Shop(), {"one": 0})
    yield forked
    forked.end()


def test_what_was_there_before_the_fork_counts_once() -> None:
    watch = MemoryWatch(lambda: None)
    alone_mb = watch.now_mb()
    before = np.ones(200 * MIB)
    forked = Forked(Shop(), {"one": 0})
    forked.call("one", "let_go").result(WITHIN_S)
    both_mb = MemoryWatch(lambda: forked.pid).now_mb()
    forked.end()
    assert before.nbytes / 2**20 - 5.0 < both_mb - alone_mb < 300.0


def test_what_the_other_takes_counts_and_the_most_is_remembered(shop: Forked) -> None:
    watch = MemoryWatch(lambda: shop.pid)
    before_mb = watch.now_mb()
    watch.look()
    shop.call("one", "keep", 150).result(WITHIN_S)
    watch.look()
    assert 145.0 < watch.now_mb() - before_mb < 200.0
    shop.call("one", "let_go").result(WITHIN_S)
    assert watch.now_mb() - before_mb < 50.0
    watch.look()
    assert 145.0 < watch.most_mb() - before_mb < 200.0


def test_arrays_that_both_have_count_once(shop: Forked) -> None:
    watch = MemoryWatch(lambda: shop.pid)
    before_mb = watch.now_mb()
    ours: NDArray[np.float64] = shop.call("one", "make_shared", 200).result(WITHIN_S)
    assert ours.sum() == 200 * MIB
    watch.look()
    for told_mb in (watch.now_mb(), watch.most_mb()):
        assert 195.0 < told_mb - before_mb < 250.0


def test_who_is_alone_or_has_lost_the_other_tells_of_itself(shop: Forked) -> None:
    alone = MemoryWatch(lambda: None)
    alone.look()
    assert 0.0 < alone.now_mb() <= alone.most_mb() + 5.0
    lost = MemoryWatch(lambda: shop.pid)
    lost.look()
    shop.end()
    lost.look()
    assert lost.now_mb() == 0.0
