"""Tables on the terminal: a figure is never cut; what is too wide stands below, under its name."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

from rich import box
from rich.cells import cell_len
from rich.console import Console
from rich.markup import escape
from rich.table import Table

# Between two columns: the right one's line, which is blank, and the left one's padding.
_GAP = 2
_LEAST_TEXT = 16


def print_table(
    console: Console,
    heads: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    keys: int = 1,
    wraps: Collection[int] = (),
    styles: Sequence[str | None] = (),
) -> None:
    """Print a table and an empty line; several of them where the terminal is too narrow for one.

    Args:
        console: how wide it is decides.
        heads: of the columns, of one line or more.
        rows: plain texts.
        keys: how many columns, from the left, name a row; they are in every table.
        wraps: columns of words, which may take several lines.
        styles: of the rows; none if not given.
    """
    widths = [
        _width([heads[k], *(row[k] for row in rows)], wraps=k in wraps) for k in range(len(heads))
    ]
    for part in _parts(widths, keys, console.width):
        table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False)
        for k in part:
            table.add_column(
                escape(heads[k]),
                justify="left" if k < keys or k in wraps else "right",
                no_wrap=k not in wraps,
                overflow="fold",
            )
        for n, row in enumerate(rows):
            style = styles[n] if styles else None
            table.add_row(*(escape(row[k]) for k in part), style=style)
        console.print(table)
        console.print()


def broken(label: str) -> str:
    """Return a head with its last word, the unit, on a line of its own."""
    return "\n".join(label.rsplit(" ", 1))


def _width(texts: Sequence[str], *, wraps: bool) -> int:
    """Return the least width of a column that cuts nothing."""
    width = max(cell_len(line) for text in texts for line in text.split("\n"))
    if not wraps:
        return width
    word = max((cell_len(word) for text in texts for word in text.split()), default=0)
    return max(word, min(width, _LEAST_TEXT))


def _parts(widths: Sequence[int], keys: int, room: int) -> Iterator[list[int]]:
    """Yield which columns fit beside each other, the keys always among them."""
    first = [*range(keys)]
    part = first
    for k in range(keys, len(widths)):
        # No line before the first column: one less than a gap for each.
        if part != first and sum(widths[n] + _GAP for n in (*part, k)) - 1 > room:
            yield part
            part = first
        part = [*part, k]
    yield part
