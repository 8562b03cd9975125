"""Small pieces of HTML for the page's panels. Everything that comes from a recording is escaped."""

from collections.abc import Iterable
from html import escape
from typing import Final

import numpy as np

from app.ui.colours import LABEL_COLOURS, LABEL_NAMES, MAP_OF, TABLES, UNIT_OF, ColourBy, Limits, Rgb

ACCENT: Final[Rgb] = (38, 166, 154)
GOOD, WARN, BAD, QUIET = "#3ecf9a", "#ffb020", "#ff6b6b", "#8b97a8"

STYLE: Final = """<style>
.hs{font-size:12.5px;line-height:1.45;padding:2px 10px 8px;overflow-wrap:anywhere}
.hs b{font-weight:600}.hs code{font-size:11px;background:rgba(127,140,160,.18);padding:1px 4px;border-radius:3px}
.hs-title{font-size:15px;font-weight:650;letter-spacing:.1px;line-height:1.3}
.hs-quiet{color:#8b97a8}
.hs-row{display:flex;justify-content:space-between;gap:8px;align-items:baseline}
.hs-chip{display:inline-block;padding:0 7px;border-radius:9px;font-size:11px;font-weight:600;line-height:18px;
white-space:nowrap;color:#10151c}
.hs-tiles{display:grid;grid-template-columns:repeat(6,1fr);gap:5px;padding:2px 10px 6px}
.hs-tile{grid-column:span 2;background:rgba(127,140,160,.11);border-radius:5px;padding:4px 8px 5px;min-width:0}
.hs-tile.half{grid-column:span 3}.hs-tile.wide{grid-column:1/7}
.hs-name{font-size:10.5px;color:#8b97a8;white-space:nowrap;overflow:hidden;text-overflow:ellipsis}
.hs-value{font-size:15px;font-weight:600;font-variant-numeric:tabular-nums;line-height:1.25;white-space:nowrap}
.hs-value small{font-size:10.5px;font-weight:400;color:#8b97a8;margin-left:3px}
.hs-note{font-size:10.5px;color:#8b97a8;line-height:1.3}
.hs-bar{height:10px;border-radius:3px;margin:3px 0 1px}
.hs-dot{display:inline-block;width:9px;height:9px;border-radius:5px;margin-right:5px}
.hs-keys{display:flex;flex-wrap:wrap;gap:3px 12px}
.hs-item{border-left:3px solid;padding:1px 0 2px 8px;margin:5px 0}
.hs-h{font-size:10.5px;font-weight:600;letter-spacing:.3px;color:#8b97a8;padding:4px 10px 3px}
[data-dock-tab]{padding-inline:6px!important}
kbd.hs-kbd{font:11px ui-monospace,monospace;border:1px solid rgba(127,140,160,.5);border-bottom-width:2px;
border-radius:4px;padding:0 5px}
</style>"""
"""Sent once, in the page's header; classes start with `hs` to stay clear of viser's own."""


def css(rgb: Rgb) -> str:
    return f"rgb({rgb[0]},{rgb[1]},{rgb[2]})"


def box(*parts: str) -> str:
    return f'<div class="hs">{"".join(parts)}</div>'


def chip(text: str, colour: str) -> str:
    return f'<span class="hs-chip" style="background:{colour}">{escape(text)}</span>'


def code(text: str) -> str:
    return f"<code>{escape(text)}</code>"


def heading(text: str) -> str:
    return f'<div class="hs-h">{escape(text)}</div>'


def key(name: str) -> str:
    return f'<kbd class="hs-kbd">{escape(name)}</kbd>'


def number(value: float, digits: int = 2) -> str:
    """Fixed digits; a dash where there is no value."""
    return f"{value:,.{digits}f}" if np.isfinite(value) else "–"


def tile(name: str, value: str, unit: str = "", *, note: str = "", colour: str = "", width: str = "") -> str:
    """A readout: a quiet name over a clear value with its unit; a third of the panel, `half` or `wide`."""
    style = f' style="color:{colour}"' if colour else ""
    small = f"<small>{escape(unit)}</small>" if unit else ""
    below = f'<div class="hs-note">{escape(note)}</div>' if note else ""
    return (
        f'<div class="hs-tile {width}"><div class="hs-name">{escape(name)}</div>'
        f'<div class="hs-value"{style}>{escape(value)}{small}</div>{below}</div>'
    )


def tiles(parts: Iterable[str]) -> str:
    return f'<div class="hs-tiles">{"".join(parts)}</div>'


def dot(rgb: Rgb, text: str) -> str:
    return f'<span><span class="hs-dot" style="background:{css(rgb)}"></span>{escape(text)}</span>'


def legend(by: ColourBy, limits: Limits | None) -> str:
    """What the colours mean, with units."""
    if by is ColourBy.LABEL:
        keys = "".join(dot(LABEL_COLOURS[label], name) for label, name in LABEL_NAMES.items())
        return box(f'<div class="hs-keys">{keys}</div>')
    table = TABLES[MAP_OF[by]]
    stops = ",".join(css((int(r), int(g), int(b))) for r, g, b in table[::32])
    low, high = ("", "") if limits is None else (f"{limits.low:g}", f"{limits.high:g}")
    return box(
        f'<div class="hs-bar" style="background:linear-gradient(90deg,{stops})"></div>',
        f'<div class="hs-row hs-note"><span>{low}</span><span>{escape(by)} · {escape(UNIT_OF[by])}</span>'
        f"<span>{high}</span></div>",
    )
