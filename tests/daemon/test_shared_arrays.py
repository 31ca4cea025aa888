"""Arrays in memory that two processes have in common."""

from __future__ import annotations

import gc
import os
import weakref
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.daemon import demo
from tests.daemon.test_map_work import workplace
from tests.daemon.waiting import run
from vcl_companion.daemon.forked import Forked
from vcl_companion.daemon.map_offer import MapOffer
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.shared_arrays import SharedMemory, place_of, shared
from vcl_companion.wire.header import BlobKind

WITHIN_S = 20.0
LARGE = 100_000


@dataclass(frozen=True, eq=False)
class Table:
    """What maps are made of: large arrays and small ones."""

    rows: NDArray[np.float64]
    columns: NDArray[np.int16]
    small: NDArray[np.float64]
    name: str


def table(seed: int = 0) -> Table:
    rng = np.random.default_rng(seed)
    columns = np.asfortranarray(rng.integers(0, 9, (LARGE, 3)), dtype=np.int16)
    return Table(rng.standard_normal((LARGE, 4)), columns, rng.standard_normal(7), "a table")


def assert_equal(found: Table, expected: Table) -> None:
    np.testing.assert_array_equal(found.rows, expected.rows)
    np.testing.assert_array_equal(found.columns, expected.columns)
    np.testing.assert_array_equal(found.small, expected.small)
    assert found.columns.flags.f_contiguous
    assert found.name == expected.name


def memory_of(array: NDArray[np.generic]) -> SharedMemory | None:
    place = place_of(array.ravel(order="K").data)
    return None if place is None else place.memory


def file_of(array: NDArray[np.generic]) -> int:
    """Number of the file that an array lies in, the same in all processes."""
    memory = memory_of(array)
    return 0 if memory is None else os.fstat(memory.descriptor).st_ino


class Shop:
    """What the tests have done elsewhere."""

    def __init__(self) -> None:
        self._made: Table | None = None

    def make(self) -> Table:
        self._made = shared(table())
        return self._made

    def file(self, given: Table | None = None) -> int:
        made = given or self._made
        assert made is not None
        return file_of(made.rows)

    def overwrite(self) -> None:
        assert self._made is not None
        self._made.rows[:] = 0.0

    def back(self, given: Table) -> Table:
        return given

    def n_files(self) -> int:
        return len(os.listdir("/proc/self/fd"))


@pytest.fixture
def shop() -> Iterator[Forked]:
    forked = Forked(Shop(), {"one": 0})
    yield forked
    forked.end()


def test_large_arrays_are_put_together_and_small_ones_stay() -> None:
    made = shared(table())
    assert_equal(made, table())
    assert memory_of(made.rows) is memory_of(made.columns) is not None
    assert memory_of(made.small) is None
    assert made.rows.ctypes.data % 64 == made.columns.ctypes.data % 64 == 0
    few = Table(np.ones((2, 4)), np.ones((2, 3), np.int16), np.ones(1), "")
    assert shared(few) is few


def test_what_is_shared_already_stays_where_it_is() -> None:
    first = shared(table())
    assert shared(first) is first
    more = shared((first, table(1)))
    assert memory_of(more[0].rows) is memory_of(first.rows)
    assert memory_of(more[1].rows) is not memory_of(first.rows)
    assert_equal(more[0], table())
    assert_equal(more[1], table(1))


def test_the_memory_goes_with_the_last_of_its_arrays() -> None:
    made = shared(table())
    memory = memory_of(made.rows)
    assert memory is not None
    descriptor, left = memory.descriptor, weakref.ref(memory)
    kept = made.columns[5:9]
    del made, memory
    gc.collect()
    assert left() is not None
    np.testing.assert_array_equal(kept, table().columns[5:9])
    del kept
    gc.collect()
    assert left() is None
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(descriptor)


def test_where_there_are_no_such_files_nothing_is_shared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "memfd_create")
    own = table()
    assert shared(own) is own


def test_a_process_hands_over_the_memory_and_not_the_bytes(shop: Forked) -> None:
    made: Table = shop.call("one", "make").result(WITHIN_S)
    assert_equal(made, table())
    assert file_of(made.rows) == shop.call("one", "file").result(WITHIN_S) != 0
    assert shop.call("one", "file", made).result(WITHIN_S) == file_of(made.rows)
    back: Table = shop.call("one", "back", made).result(WITHIN_S)
    assert file_of(back.rows) == file_of(made.rows)
    assert_equal(back, table())
    # With arrays that are not shared, in one message.
    both: tuple[Table, Table] = shop.call("one", "back", (made, table(1))).result(WITHIN_S)
    assert_equal(both[0], table())
    assert_equal(both[1], table(1))


def test_what_one_writes_the_other_does_not_see(shop: Forked) -> None:
    made: Table = shop.call("one", "make").result(WITHIN_S)
    shop.call("one", "overwrite").result(WITHIN_S)
    assert_equal(made, table())


def test_files_are_closed_when_nobody_needs_them(shop: Forked) -> None:
    def n_files() -> tuple[int, int]:
        gc.collect()
        return len(os.listdir("/proc/self/fd")), shop.call("one", "n_files").result(WITHIN_S)

    shop.call("one", "make").result(WITHIN_S)
    before = n_files()
    for _ in range(5):
        made: Table = shop.call("one", "make").result(WITHIN_S)
        shop.call("one", "file", made).result(WITHIN_S)
        del made
    assert n_files() == before


def test_a_map_that_is_made_ready_is_there_once() -> None:
    async def check() -> None:
        work = MapWork(workplace(), forks=True)
        offer = MapOffer.of(BlobKind.MAP, demo.encoded_map(1, 2, 3))
        ready = await work.ready(offer, None, {})
        assert ready.templates is not None
        assert memory_of(ready.templates.anchors.images.texels) is not None
        work.end()

    run(check())
