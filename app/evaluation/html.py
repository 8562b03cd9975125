"""The report as one page that needs nothing else: tables, charts and pieces of the maps."""

from collections.abc import Sequence
from html import escape

import numpy as np

from app.evaluation import crops, svg
from app.evaluation.measured import Evaluated
from app.evaluation.tables import Table
from app.slam.types import STAGES


def html(recordings: Sequence[Evaluated], tables: Sequence[Table], findings: Sequence[str], made_by: str) -> str:
    names = dict.fromkeys(column.name for recording in recordings for column in recording.columns if not column.missing)
    colours = {name: svg.PALETTE[index % len(svg.PALETTE)] for index, name in enumerate(names)}
    contents = "".join(f'<a href="#{_anchor(table.title)}">{escape(table.title)}</a>' for table in tables)
    contents += "".join(f'<a href="#{_anchor(r.name)}">{escape(r.name)}</a>' for r in recordings)
    body = [
        f"<header><h1>Evaluation</h1><p>{escape(made_by)}</p><nav>{contents}</nav></header>",
        '<section class="findings"><h2>In short</h2><ul>',
        *(f"<li>{escape(finding)}</li>" for finding in findings),
        "</ul></section>" if findings else "<li>Nothing to compare.</li></ul></section>",
        *(_table(table) for table in tables),
        *(_recording(recording, colours) for recording in recordings),
        _variants(recordings),
    ]
    return _PAGE.replace("<!--body-->", "\n".join(body))


def _table(table: Table) -> str:
    head = "".join(f"<th>{escape(name)}</th>" for name in table.columns)
    rows, group = [], None
    for row in table.rows:
        cells = "".join(
            f'<td class="best">{escape(cell)}</td>' if index in row.best else f"<td>{escape(cell)}</td>"
            for index, cell in enumerate(row.cells)
        )
        first = ' class="first"' if row.group != group else ""
        shown = escape(row.group) if row.group != group else ""
        rows.append(f'<tr{first}><th class="group">{shown}</th><th>{escape(row.label)}</th>{cells}</tr>')
        group = row.group
    title = f"<h2>{escape(table.title)}</h2>"
    content = (
        (f'<p class="note">{escape(table.note)}</p>' if table.note else "") + '<div class="scroll"><table>'
        f"<thead><tr><th>recording</th><th></th>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
    )
    inner = f"<details><summary>{title}</summary>{content}</details>" if table.folded else title + content
    return f'<section id="{_anchor(table.title)}">{inner}</section>'


def _recording(recording: Evaluated, colours: dict[str, str]) -> str:
    there = [column for column in recording.columns if column.trajectory is not None]
    figures = [_above(recording, colours)]
    measured = [column for column in there if column.accuracy]
    if measured:
        lines = [
            svg.Line(c.name, colours[c.name], c.accuracy.times_s, c.accuracy.errors_m) for c in measured if c.accuracy
        ]
        picture = svg.chart(lines, "time (s)", "position error (m)", from_zero=True)
        figures.append(_figure(picture, "Position error over time, after the alignment"))
    timed = [column for column in there if column.timings_ms is not None and len(column.timings_ms)]
    if timed:
        totals = {c.name: c.timings_ms[:, -1] for c in timed if c.timings_ms is not None}
        last = float(np.percentile(np.concatenate(list(totals.values())), 99.5))
        edges = np.linspace(0, last, 61)
        lines = [svg.histogram(name, colours[name], values, edges) for name, values in totals.items()]
        picture = svg.chart(lines, "time a frame (ms)", "frames (%)", from_zero=True)
        figures.append(_figure(picture, "How long frames take"))
        bars = [
            (c.name, [float(np.mean(c.timings_ms[:, k])) for k in range(len(STAGES))])
            for c in timed
            if c.timings_ms is not None
        ]
        marks = svg.legend(list(zip(STAGES, svg.PALETTE, strict=False)))
        figures.append(_figure(marks + svg.stacked(bars, STAGES, "ms"), "Mean time by stage"))
    entries = [(column.name, colours[column.name]) for column in there]
    if recording.truth_path is not None:
        entries.append(("truth", svg.TRUTH))
    notes = "".join(f"<li>{escape(note)}</li>" for note in recording.notes)
    facts = f"<ul class='note'><li>{escape(recording.truth or 'Without truth.')}</li>{notes}</ul>"
    return (
        f'<section id="{_anchor(recording.name)}"><h2>{escape(recording.name)}</h2>{facts}{svg.legend(entries)}'
        f'<div class="figures">{"".join(figures)}</div>{_maps(recording)}'
        f'<p class="note">{escape(recording.recording.name)}, SHA-256 <code>{recording.sha256}</code></p></section>'
    )


def _above(recording: Evaluated, colours: dict[str, str]) -> str:
    """All trajectories from above, in the truth's world if there is one."""
    lines = []
    if recording.truth_path is not None:
        lines.append(svg.Line("truth", svg.TRUTH, recording.truth_path[:, 0], recording.truth_path[:, 1], dashed=True))
    for column in recording.columns:
        if column.trajectory is None:
            continue
        if column.accuracy is not None:
            places = column.accuracy.aligned
        elif recording.truth_path is None:
            places = column.trajectory.positions
        else:
            continue
        lines.append(svg.Line(column.name, colours[column.name], places[:, 0], places[:, 1]))
    if not lines:
        return ""
    picture = svg.chart(lines, "x (m)", "y (m)", equal=True, height=420)
    return _figure(picture, "From above")


def _maps(recording: Evaluated) -> str:
    """The same piece of every variant's map, side by side."""
    rows = []
    for place in crops.PLACES:
        pieces = [(column.name, column.crops[place]) for column in recording.columns if place in column.crops]
        if not pieces:
            continue
        filled = [counts[counts > 0] for _, counts in pieces if counts.any()]
        brightest = float(np.percentile(np.concatenate(filled), 99)) if filled else 1.0
        tiles = "".join(
            f"<figure>{svg.density_image(counts, brightest)}<figcaption>{escape(name)}</figcaption></figure>"
            for name, counts in pieces
        )
        rows.append(f'<h3>The map: {escape(place)}</h3><div class="maps">{tiles}</div>')
    size = 2 * crops.HALF_M
    note = (
        f'<p class="note">{size:g} × {size:g} m from above, {crops.SLICE_M[0]:+g} to {crops.SLICE_M[1]:+g} m about the'
        " sensor's height, brighter where more points fall. Double or thick walls are errors.</p>"
    )
    return "".join(rows) + note if rows else ""


def _variants(recordings: Sequence[Evaluated]) -> str:
    meanings = {c.name: c.missing or c.meaning or "as given" for recording in recordings for c in recording.columns}
    rows = "".join(f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>" for name, text in meanings.items())
    return f"<section><h2>Variants</h2><dl>{rows}</dl></section>"


def _figure(picture: str, caption: str) -> str:
    return f"<figure>{picture}<figcaption>{escape(caption)}</figcaption></figure>"


def _anchor(title: str) -> str:
    return "".join(letter if letter.isalnum() else "-" for letter in title.lower())


_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width,initial-scale=1">
<title>hemislam evaluation</title>
<style>
:root{--ink:#1f2937;--soft:#6b7280;--line:#e5e7eb;--paper:#fff;--back:#f6f7f9;--best:#ecfdf3}
*{box-sizing:border-box}
body{margin:0;background:var(--back);color:var(--ink);font:14px/1.5 system-ui,-apple-system,"Segoe UI",sans-serif}
header,section{max-width:1240px;margin:16px auto;padding:20px 28px;background:var(--paper);border:1px solid var(--line);
border-radius:10px}
h1{margin:0 0 4px;font-size:24px}h2{margin:0 0 8px;font-size:18px}h3{margin:20px 0 8px;font-size:14px}
header p,.note{color:var(--soft);margin:0 0 12px}.note{font-size:12.5px;padding-left:0}ul.note{list-style:none}
summary{cursor:pointer}summary h2{display:inline}details[open] summary{margin-bottom:8px}
.findings ul{margin:0;padding-left:20px}
nav{display:flex;flex-wrap:wrap;gap:6px 16px}a{color:#2563eb;text-decoration:none}a:hover{text-decoration:underline}
.scroll{overflow-x:auto}
table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums}
th,td{padding:4px 12px;text-align:right;white-space:nowrap}
tbody th{font-weight:400;text-align:left;color:var(--soft)}tbody th.group{color:var(--ink);font-weight:600}
thead th{border-bottom:2px solid var(--line);font-weight:600}thead th:first-child{text-align:left}
tr.first td,tr.first th{border-top:1px solid var(--line)}
td.best{font-weight:650;background:var(--best)}
.figures{display:grid;grid-template-columns:repeat(auto-fit,minmax(420px,1fr));gap:16px;align-items:start}
figure{margin:0}figcaption{color:var(--soft);font-size:12.5px;text-align:center;margin-top:2px}
.maps{display:grid;grid-template-columns:repeat(auto-fill,minmax(270px,1fr));gap:12px}
.maps img{width:100%;border-radius:6px;display:block}
.chart{width:100%;height:auto;font-size:11px}.chart text{fill:var(--soft)}.chart .axis{fill:var(--ink)}
.grid{stroke:var(--line);stroke-width:1}
.legend{display:flex;flex-wrap:wrap;gap:4px 16px;margin:4px 0 8px}
.legend i{display:inline-block;width:14px;height:4px;border-radius:2px;margin-right:6px;vertical-align:middle}
dl{display:grid;grid-template-columns:max-content 1fr;gap:4px 20px;margin:0}dt{font-weight:600}dd{margin:0}
code{font-size:11px;word-break:break-all}
</style></head><body>
<!--body-->
</body></html>
"""
