"""Clicks on the page's own HTML that reach the server.

viser has no events for HTML. An element that names a word in `data-hs` writes it into a text field
that nobody sees, whose changes viser sends. A number behind the word makes every click a change.
"""

from collections.abc import Callable
from html import escape
from typing import Final

import viser

from app.ui.keys import ONE_PIXEL
from app.ui.widgets import by_user

_LABEL: Final = "page to server"

_SCRIPT: Final = """
if (!window.hemislamSay) {
  window.hemislamSaid = 0;
  const set = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, 'value').set;
  window.hemislamSay = (event) => {
    const element = event.target.closest && event.target.closest('[data-hs]');
    if (!element || (event.type === 'keydown' && event.key !== 'Enter')) return;
    const label = document.querySelector(`label[for="${element.closest('[data-hs-to]').dataset.hsTo}"]`);
    const input = label.closest('.mantine-Flex-root').querySelector('input');
    set.call(input, element.dataset.hs + ' #' + (++window.hemislamSaid) + Math.random().toString(36).slice(2, 6));
    input.dispatchEvent(new Event('input', {bubbles: true}));
  };
}
"""


class Bridge:
    """Calls `act` with the word of what was clicked (or chosen with Enter), and the browser."""

    def __init__(self, gui: viser.GuiApi, act: Callable[[str, viser.ClientHandle], None]) -> None:
        self._field = gui.add_text(_LABEL, "")
        self._to = self._field._impl.uuid  # no public name, and the page knows its elements by nothing else
        gui.add_html(
            f'<style>.mantine-Flex-root:has(label[for="{self._to}"]){{display:none}}</style>'
            f'<img src="{ONE_PIXEL}" hidden onload="{escape(_SCRIPT)}">'
        )
        self._field.on_update(by_user(lambda text, client: act(text.split(" #")[0], client)))

    def live(self, html: str) -> str:
        """HTML whose elements with `data-hs` can be clicked."""
        return f'<div data-hs-to="{self._to}" onclick="hemislamSay(event)" onkeydown="hemislamSay(event)">{html}</div>'
