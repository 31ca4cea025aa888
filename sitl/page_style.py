"""How pages look here: one style sheet, one frame; nothing is fetched."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

Column = tuple[str, str, str, float | None]

CSS = """
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { margin: 0; background: #f5f7fa; color: #1f2933;
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
main { max-width: 1120px; margin: 0 auto; padding: 40px 24px 64px; }
h1 { font-size: 30px; line-height: 1.2; margin: 0 0 4px; letter-spacing: -0.01em; }
h2 { font-size: 19px; margin: 0 0 10px; }
p.lead { color: #52606d; margin: 0 0 24px; }
p.note { color: #52606d; font-size: 14px; margin: -6px 0 12px; max-width: 78ch; }
section { background: #fff; border: 1px solid #e4e7eb; border-radius: 10px;
  padding: 22px 24px; margin-top: 20px; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(170px, 1fr)); gap: 14px; }
.tile { background: #fff; border: 1px solid #e4e7eb; border-radius: 10px; padding: 14px 18px; }
.tile b { display: block; font-size: 26px; line-height: 1.25; font-weight: 650;
  font-variant-numeric: tabular-nums; }
.tile span { color: #52606d; font-size: 14px; }
.bad { color: #b42318; }
.alarm { border-color: #f3b7b1; background: #fef3f2; }
.alarm ul { margin: 4px 0 0; padding-left: 20px; }
table { border-collapse: collapse; width: 100%; font-size: 14.5px;
  font-variant-numeric: tabular-nums; }
th, td { padding: 7px 10px; text-align: right; border-bottom: 1px solid #e4e7eb;
  white-space: nowrap; }
th { color: #52606d; font-weight: 600; font-size: 13px; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
td.text, th.text { text-align: left; white-space: normal; }
tr:last-child td { border-bottom: 0; }
.swatch { display: inline-block; width: 11px; height: 11px; border-radius: 3px;
  margin-right: 8px; }
.scroll { overflow-x: auto; } .scroll + .scroll { margin-top: 26px; }
svg[role=img] { width: 100%; height: auto; display: block; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 4px 20px; margin: 0;
  font-size: 14.5px; }
dt { color: #52606d; } dd { margin: 0; overflow-wrap: anywhere; }
"""


def document(title: str, heading: str, lead: str, parts: Iterable[str]) -> str:
    """Return a whole page; empty parts are left out, all text is HTML already."""
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{title}</title>\n<style>{CSS}</style>\n</head>\n<body>\n<main>\n"
        f"<h1>{heading}</h1>\n<p class=lead>{lead}</p>\n"
        + "\n".join(filter(None, parts))
        + "\n</main>\n</body>\n</html>\n"
    )


def section(title: str, note: str, content: str) -> str:
    """Return a titled part of a page; note and content are HTML."""
    noted = f"<p class=note>{note}</p>" if note else ""
    return f"<section>\n<h2>{title}</h2>{noted}{content}\n</section>"


def cells(columns: Sequence[Column], values: Mapping[str, Any], none: str) -> list[str]:
    """Return a row's values as texts by its columns: key, head, format, and scale of a number."""
    out = []
    for key, _, form, scale in columns:
        value = values[key]
        out.append(none if value is None else form.format(scale * value if scale else value))
    return out


def drones_table(report: Mapping[str, Any], part: str, columns: Sequence[Column]) -> str:
    """Return a table of one part of each drone's report; empty when none has it."""
    rows = [
        [name, *cells(columns, drone[part], "—")]
        for name, drone in report["drones"].items()
        if drone[part]
    ]
    return table(["drone", *(label for _, label, _, _ in columns)], rows) if rows else ""


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table of plain texts, as wide as it needs to be."""
    head = "".join(f"<th>{escape(text)}</th>" for text in heads)
    lines = ("".join(f"<td>{escape(text)}</td>" for text in row) for row in rows)
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f"<div class=scroll><table><tr>{head}</tr>{body}</table></div>"
