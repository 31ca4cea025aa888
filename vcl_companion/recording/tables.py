"""Rows of the recording's csv files, with errors that name the file and the row.

A row's number is its line in the file, as an editor shows it; lines that are
empty or begin with ``#`` are headers and comments.
"""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vcl_companion.errors import RecordingError
from vcl_companion.geometry.rotation import Array
from vcl_companion.text_file import read_text

_MAX_NS = 2**63 - 1
_MAX_SECONDS = 2**33  # of nanoseconds that fit 63 bits, the nearest power of two below
# Far beyond any flight, and far from where differences of floats overflow.
_MAX_VALUE = 1e9
MOST_BYTES = 1 << 30
"""Longest table of any flight."""


@dataclass(frozen=True)
class Row:
    """One line of a table.

    Attributes:
        path: the file.
        number: its line, from 1.
        cells: its text, without blanks around.
    """

    path: Path
    number: int
    cells: tuple[str, ...]

    def error(self, problem: str) -> RecordingError:
        """Return the one line for a person: file, row, problem."""
        return RecordingError(f"{self.path}, row {self.number}: {problem}")

    def timestamp_ns(self, column: int = 0) -> int:
        """Return a cell as an instant, ns."""
        cell = self.cells[column]
        if not (cell.isascii() and cell.isdigit()) or len(cell) > 19 or int(cell) > _MAX_NS:
            raise self.error(f"{cell[:40]!r} is not a timestamp in whole nanoseconds")
        return int(cell)

    def seconds_as_ns(self, column: int = 0) -> int:
        """Return a cell of decimal seconds as an instant, ns, without rounding through a float."""
        cell = self.cells[column]
        try:
            seconds = Decimal(cell) if "_" not in cell else Decimal("NaN")
            at_ns = round(seconds * 1_000_000_000) if 0 <= seconds <= _MAX_SECONDS else None
        except ArithmeticError:
            at_ns = None
        if at_ns is None:
            raise self.error(f"{cell[:40]!r} is not a timestamp in seconds")
        return at_ns

    def value(self, column: int) -> float:
        """Return a cell as a finite number."""
        cell = self.cells[column]
        try:
            number = float(cell) if "_" not in cell else None
        except ValueError:
            number = None
        if number is None:
            raise self.error(f"column {column + 1}: {cell[:40]!r} is not a number")
        if not abs(number) <= _MAX_VALUE:
            raise self.error(f"column {column + 1}: {cell[:40]!r} is not a usable number")
        return number


@dataclass(frozen=True, eq=False)
class Samples:
    """A table of timestamped numbers.

    Attributes:
        at_ns: (T,) int64, strictly increasing.
        values: (T, C) what follows the timestamp, finite.
        rows: (T,) where each stands, for messages about its content.
    """

    at_ns: NDArray[np.int64]
    values: Array
    rows: tuple[Row, ...]


def read_rows(path: Path, advice: str, separator: str | None = ",") -> list[Row]:
    """Read the rows of a table; ``separator`` None splits at blanks.

    Args:
        path: the file.
        advice: what to do when it is not there, for the message.
        separator: what stands between two cells.

    Raises:
        RecordingError: absent, not text, or without any row.
    """
    try:
        text = read_text(path, MOST_BYTES)
    except FileNotFoundError:
        raise RecordingError(f"{path}: missing; {advice}") from None
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError:
        raise RecordingError(f"{path}: not a text file") from None
    rows = split_rows(path, text, separator)
    if not rows:
        raise RecordingError(f"{path}: no rows; {advice}")
    return rows


def split_rows(path: Path, text: str, separator: str | None) -> list[Row]:
    """Split a table's text; ``separator`` None splits at blanks."""
    return [
        Row(path, number, tuple(cell.strip() for cell in line.split(separator)))
        for number, line in enumerate(text.split("\n"), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]


def check_order(row: Row, at_ns: int, previous: tuple[Row, int] | None) -> None:
    """Refuse a row whose instant does not follow that of the row before it."""
    if previous is None or at_ns > previous[1]:
        return
    before = f"row {previous[0].number}"
    if at_ns == previous[1]:
        raise row.error(f"timestamp {at_ns} is that of {before} again; remove one of the two")
    raise row.error(f"timestamp {at_ns} is earlier than {before}; sort the rows by time")


def read_samples(path: Path, n_columns: tuple[int, ...], advice: str) -> Samples:
    """Read a table of a timestamp and numbers.

    Args:
        path: the file.
        n_columns: how many columns a row may have, the timestamp included; all alike.
        advice: what to do when it is not there, for the message.

    Raises:
        RecordingError: a row is malformed, not finite or out of order.
    """
    rows = read_rows(path, advice)
    width = len(rows[0].cells)
    if width not in n_columns:
        expected = " or ".join(map(str, n_columns))
        raise rows[0].error(f"{width} columns, expected {expected} separated by commas")
    at_ns = np.empty(len(rows), dtype=np.int64)
    values = np.empty((len(rows), width - 1))
    previous: tuple[Row, int] | None = None
    for k, row in enumerate(rows):
        if len(row.cells) != width:
            raise row.error(f"{len(row.cells)} columns where row {rows[0].number} has {width}")
        instant = row.timestamp_ns()
        check_order(row, instant, previous)
        previous = row, instant
        at_ns[k] = instant
        values[k] = [row.value(column) for column in range(1, width)]
    return Samples(at_ns, values, tuple(rows))
