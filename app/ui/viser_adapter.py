"""Everything that relies on the structure of viser's page; `tests/ui/test_viser_contract.py` checks it.

viser has no events for HTML and no way to run a script, and it has keys of its own. So this module assumes:

* HTML elements are inserted as they are, and an `<img onload=...>` in them runs.
* The elements of a container are siblings, in the order in which they were added: a text field directly before some
  HTML is the previous sibling of that HTML.
* A text field is an `<input>` whose `input` events viser sends.
* Hotkeys are listened to on the html element, the camera's keys on the document.
* A button has the class `mantine-Button-root`, and `gray-filled` in its style if it is gray; a text field has the class
  `mantine-TextInput-input`.
* A number box is an `<input class="mantine-NumberInput-input">` whose `input` events viser sends; that of a slider
  is beside its track.
* Tooltips have the class `mantine-Tooltip-tooltip`, and the scene is a `<canvas data-engine>`.
* A phone's panel has its largest height and its width in its style; a folder is a Paper with a border. Its head is
  another Paper, with the cursor of a pointer, and its icon is chevron-down while it is closed.
* While the server is not connected, panels are dimmed with a transition of 150 ms and take no clicks.
* The scene is inset by the width of the docked panel, whose chevron carries `data-dock-region-collapse`.
* The hint of a button is in the properties of a React component around it, whose type is that of its message.
* Dock tabs carry `data-dock-tab`; the tab that is shown has `aria-selected`. The two buttons beside the title have the
  icons list-search and adjustments. The box of a slider follows its track, with Mantine's class names.
"""

from collections.abc import Callable, Iterable

import viser

from app.ui.html import panel, source
from app.ui.widgets import by_user


def page_parts(speeds: Iterable[str]) -> str:
    """HTML of ours beside viser's panel: the style sheets, the bar with these speeds, and the scripts."""
    styles = source("style.css") + source("viser_adapter.css")
    scripts = [source(f"{name}.js") for name in ("viser_adapter", "transport", "tour", "drop")]
    return panel("page_parts", styles, list(speeds), scripts)


class Bridge:
    """Sends clicks on the page's own HTML to the server.

    A clicked element writes the word in its `data-hs` into a hidden text field, whose changes viser sends.

    Args:
        name: unique among all bridges. act: called with the word of the element that was clicked, or chosen with
            Enter, and the browser.
    """

    def __init__(self, gui: viser.GuiApi, name: str, act: Callable[[str, viser.ClientHandle], None]) -> None:
        self._name = name
        self._field = gui.add_text(name, "")
        gui.add_html(panel("bridge", name))
        self._field.on_update(by_user(lambda text, client: act(text.rsplit(" #", 1)[0], client)))

    def live(self, html: str) -> str:
        """HTML whose elements with `data-hs` can be clicked."""
        return panel("bridged", self._name, html)
