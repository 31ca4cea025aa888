"""Tables on the terminal: no figure is cut however narrow it is, and none is left out."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence

import pytest
from rich.console import Console

from sitl.tables import broken, print_table


def printed(
    width: int, heads: Sequence[str], rows: Sequence[Sequence[str]], wraps: tuple[int, ...] = ()
) -> list[str]:
    out = io.StringIO()
    print_table(Console(file=out, width=width), heads, rows, wraps=wraps)
    return [line.rstrip() for line in out.getvalue().splitlines()]


@pytest.mark.parametrize("n_rows", [1, 3, 6])
@pytest.mark.parametrize("width", [20, 40, 80, 120])
def test_what_is_too_wide_stands_below_under_its_name(width: int, n_rows: int) -> None:
    heads = ["drone", *(broken(f"figure{k} ms") for k in range(11))]
    rows = [[f"mav{n}", *(f"{n}{k:02}.125" for k in range(11))] for n in range(n_rows)]
    lines = printed(width, heads, rows)
    assert max(map(len, lines)) <= width
    for row in rows:
        of_it = [line.split()[1:] for line in lines if line.startswith(row[0])]
        assert [figure for part in of_it for figure in part] == row[1:]
    n_tables = lines.count("")
    assert (n_tables == 1) == (width == 120)
    assert [head for line in lines for head in re.findall(r"figure\d+", line)] == [
        f"figure{k}" for k in range(11)
    ]


def test_a_table_that_just_fits_is_one() -> None:
    heads, rows = ["drone", "ATE\nm", "p99\nms"], [["mav0", "0.002", "150.7"]]
    assert printed(20, heads, rows)[-2:] == ["mav0   0.002  150.7", ""]
    assert printed(19, heads, rows).count("") == 2


def test_words_take_more_lines_before_figures_go_elsewhere() -> None:
    heads, rows = (
        ["step", "median\nms", "accuracy"],
        [["match", "56.5", "1219 [of] 1300 are right"]],
    )
    lines = printed(34, heads, rows, wraps=(2,))
    assert lines.count("") == 1
    assert lines[3].startswith("match    56.5  1219 [of]")
    assert " ".join(" ".join(lines).split()).endswith("right")
