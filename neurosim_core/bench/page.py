"""A report as one HTML page that needs nothing else: no script, no font, no file beside it."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape

from markdown_it import MarkdownIt

from neurosim_core.bench.chapter import Bar, Chapter, Table, cells, numeric_columns, to_csv

_LONG = 24  # rows, from which on a table is folded
_CLASSES = {True: "met", False: "missed", None: "open"}
_SIGNS = {True: "✓", False: "✗", None: "–"}
_MARKDOWN = MarkdownIt("commonmark", {"html": False}).enable("table")

_STYLE = """
:root { --ink: #1c2430; --soft: #5b6675; --line: #dfe4ea; --paper: #fff; --wash: #f5f7f9;
        --met: #0a7a4b; --missed: #b3261e; --open: #8a6100; }
* { box-sizing: border-box; }
body { margin: 0; background: var(--wash); color: var(--ink);
       font: 16px/1.6 system-ui, -apple-system, "Segoe UI", Roboto, "Noto Sans", sans-serif; }
main { max-width: 70rem; margin: 0 auto; padding: 2.5rem 1.25rem 5rem; }
h1 { font-size: 2.1rem; line-height: 1.2; margin: 0 0 .3rem; letter-spacing: -.01em; }
h2 { font-size: 1.45rem; line-height: 1.25; margin: 0 0 .6rem; letter-spacing: -.005em; }
h3 { font-size: 1rem; margin: 2rem 0 .5rem; }
p { margin: .5rem 0; max-width: 46rem; }
a { color: #0b5cad; }
code { font: .88em ui-monospace, "SF Mono", Menlo, Consolas, "DejaVu Sans Mono", monospace;
       background: var(--wash); padding: .1em .3em; border-radius: 4px; overflow-wrap: anywhere; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .15rem 1rem; margin: 1rem 0 0;
     font-size: .875rem; }
dt { color: var(--soft); }
dd { margin: 0; overflow-wrap: anywhere; }
dd code { background: none; padding: 0; }
section { background: var(--paper); border: 1px solid var(--line); border-radius: 12px;
          padding: 1.75rem 2rem; margin-top: 1.5rem; }
.score { font-size: 1.15rem; margin: 0 0 1rem; }
.score b { font-variant-numeric: tabular-nums; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .875rem; line-height: 1.45; }
th, td { text-align: left; padding: .4rem 1.1rem .4rem 0; border-bottom: 1px solid var(--line);
         vertical-align: top; }
thead th { font-weight: 600; color: var(--soft); vertical-align: bottom; border-bottom-width: 2px; }
tbody tr:hover { background: var(--wash); }
.number { text-align: right; font-variant-numeric: tabular-nums; }
td.number { white-space: nowrap; }
.bars th { font-weight: 600; padding-top: 1.1rem; }
.bars td p { margin: 0; }
.bars td:first-child { width: 10rem; white-space: nowrap; }
.bars td:last-child { width: 38%; }
.verdict { font-weight: 600; }
.met { color: var(--met); } .missed { color: var(--missed); } .open { color: var(--open); }
figure { margin: 1.5rem 0; }
img { display: block; width: 100%; height: auto; }
.command { color: var(--soft); font-size: .875rem; margin: 0 0 1rem; }
.note, .note p { color: var(--soft); font-size: .875rem; }
.file { font-size: .75rem; font-weight: 400; margin-left: .4rem; }
summary { cursor: pointer; color: #0b5cad; font-size: .875rem; }
@media (max-width: 40rem) { section { padding: 1.25rem 1rem; } .bars td:first-child { width: auto; } }
@media print { body { background: none; } section { border: 0; padding: 0; break-inside: avoid-page; }
               details > * { display: block; } }
"""


def html_page(
    chapters: Sequence[Chapter], pictures: Mapping[str, bytes], *, title: str, facts: Mapping[str, str]
) -> str:
    """Return the page.

    Args:
        chapters: What it says; all of their text is escaped.
        pictures: PNG of each plot by its name; one that is missing is left out, and said to be.
        title: Of the whole.
        facts: What holds for all of it, such as date and machine: term -> text.
    """
    body = [
        f"<header><h1>{escape(title)}</h1>{_facts(facts)}</header>",
        _overview(chapters),
        *(_chapter(chapter, pictures) for chapter in chapters),
    ]
    return "\n".join(
        [
            "<!doctype html>",
            '<html lang="en"><head><meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            '<link rel="icon" href="data:,">',
            f"<title>{escape(title)}</title><style>{_STYLE}</style></head><body><main>",
            *body,
            "</main></body></html>\n",
        ]
    )


def _facts(facts: Mapping[str, str]) -> str:
    items = (f"<dt>{escape(term)}</dt><dd>{_inline(text)}</dd>" for term, text in facts.items())
    return f"<dl>{''.join(items)}</dl>"


def _overview(chapters: Sequence[Chapter]) -> str:
    """Return all bars by chapter, under how many of them are met."""
    bars = [bar for chapter in chapters for bar in chapter.bars]
    counts = {met: sum(bar.met is met for bar in bars) for met in _SIGNS}
    score = (
        f'<b class="met">{counts[True]} met</b>, <b class="missed">{counts[False]} missed</b>, '
        f'<b class="open">{counts[None]} not measured here</b>'
    )
    groups = [
        f'<tbody><tr><th colspan="3"><a href="#{chapter.name}">{escape(chapter.title)}</a></th></tr>'
        f"{''.join(map(_bar, chapter.bars)) or _NO_BARS}</tbody>"
        for chapter in chapters
    ]
    return (
        f'<section id="bars"><h2>What was promised, and what was measured</h2><p class="score">{score}</p>'
        f'<div class="scroll"><table class="bars">{"".join(groups)}</table></div></section>'
    )


_NO_BARS = '<tr><td></td><td colspan="2" class="note">nothing was promised</td></tr>'


def _bar(bar: Bar) -> str:
    return (
        f'<tr><td class="verdict {_CLASSES[bar.met]}">{_SIGNS[bar.met]} {bar.verdict}</td>'
        f"<td>{_inline(bar.text)}</td><td>{escape(bar.measured)}</td></tr>"
    )


def _chapter(chapter: Chapter, pictures: Mapping[str, bytes]) -> str:
    parts = [
        f'<section id="{chapter.name}"><h2>{escape(chapter.title)}</h2>',
        f'<p class="command"><code>{escape(chapter.command)}</code></p>',
        _MARKDOWN.render(chapter.summary),
    ]
    for plot in chapter.plots:
        if plot.name in pictures:
            data = base64.b64encode(pictures[plot.name]).decode("ascii")
            parts.append(
                f'<figure><img alt="{escape(plot.title)}" src="data:image/png;base64,{data}"></figure>'
            )
        else:
            parts.append(f'<p class="note">{escape(plot.title)}: not drawn, matplotlib is not installed.</p>')
    parts += map(_table, chapter.tables)
    return "\n".join([*parts, "</section>"])


def _table(table: Table) -> str:
    numeric = numeric_columns(table)
    classes = [' class="number"' if key in numeric else "" for key in table.columns]
    head = "".join(
        f"<th{style}>{escape(heading)}</th>"
        for style, heading in zip(classes, table.columns.values(), strict=True)
    )
    rows = "".join(
        f"<tr>{''.join(f'<td{s}>{escape(text)}</td>' for s, text in zip(classes, row, strict=True))}</tr>"
        for row in cells(table)
    )
    grid = (
        f'<div class="scroll"><table id="{table.name}"><thead><tr>{head}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div>"
    )
    if len(table.rows) > _LONG:
        grid = f"<details><summary>{len(table.rows)} rows</summary>{grid}</details>"
    note = f'<div class="note">{_MARKDOWN.render(table.note)}</div>' if table.note else ""
    data = base64.b64encode(to_csv(table).encode("utf-8")).decode("ascii")
    link = f'<a class="file" download="{table.name}.csv" href="data:text/csv;base64,{data}">CSV</a>'
    return f"<h3>{escape(table.title)} {link}</h3>{grid}{note}"


def _inline(text: str) -> str:
    return str(_MARKDOWN.renderInline(text))
