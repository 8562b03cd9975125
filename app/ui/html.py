"""HTML of the page's panels: templates (`app/ui/templates`) that escape everything put into them."""

from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from app.ui.hints import HINTS

_FOLDER: Final = Path(__file__).parent / "templates"
GOOD, WARN, BAD, QUIET = (f"var(--hs-{name})" for name in ("good", "warn", "bad", "quiet"))
"""CSS colours of a reading, from fine to bad, and of what matters little: readable on either background."""

ONE_PIXEL: Final = "data:image/gif;base64,R0lGODlhAQABAAAAACH5BAEKAAEALAAAAAABAAEAAAICTAEAOw=="
"""The smallest image: its `onload` is how HTML in viser's page runs a script."""


class Tile(NamedTuple):
    """A readout: a quiet name over a clear value. width: "" is a third of the panel, or `half` or `wide`."""

    name: str
    value: str
    unit: str = ""
    note: str = ""
    colour: str = ""
    width: str = ""


_TEMPLATES: Final = Environment(
    loader=FileSystemLoader(_FOLDER), autoescape=True, trim_blocks=True, undefined=StrictUndefined
)
_TEMPLATES.globals |= {"ONE_PIXEL": ONE_PIXEL, "HINTS": HINTS}


def panel(name: str, *args: Any) -> str:
    """The HTML of a macro: "note" of `panels.html`, "loops.table" of `loops.html`, "macros.tiles" of `macros.html`."""
    template, _, macro = name.rpartition(".")
    return str(getattr(_TEMPLATES.get_template(f"{template or 'panels'}.html").module, macro)(*args))


def render(template: str) -> str:
    """The HTML of a template without parameters."""
    return _TEMPLATES.get_template(template).render()


def source(name: str) -> str:
    """The text of a style sheet or a script among the templates."""
    return (_FOLDER / name).read_text(encoding="utf-8")


def css(rgb: tuple[int, int, int]) -> str:
    return f"rgb({rgb[0]},{rgb[1]},{rgb[2]})"


def heading(text: str) -> str:
    return panel("macros.heading", text)


def number(value: float, digits: int = 2) -> str:
    """Fixed digits; a dash where there is no value."""
    return f"{value:,.{digits}f}" if np.isfinite(value) else "–"
