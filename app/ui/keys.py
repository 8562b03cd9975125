"""Keys that viser's page would give to two takers.

viser turns the camera with the arrow keys, and its command hotkeys also fire while a slider or a tab
has the focus. There is no setting for that, and no hook for scripts but an element's own handler.
"""

from html import escape
from typing import Final

# Order of the taker on the way up from the element that has the focus: widgets (the page's root),
# the body, hotkeys (the html element), the camera (the document).
_SCRIPT: Final = """
if (!window.hemislamKeys) {
  window.hemislamKeys = true;
  const sideways = (event) => event.key === 'ArrowLeft' || event.key === 'ArrowRight';
  document.body.addEventListener('keydown', (event) => {
    if (sideways(event) && event.target.closest('[role=slider],[role=tab]')) event.stopPropagation();
  });
  document.documentElement.addEventListener('keydown', (event) => {
    if (sideways(event)) event.stopPropagation();
  });
  document.documentElement.addEventListener('keyup', (event) => {
    if (event.key === ' ' && event.target.closest('button')) event.preventDefault();
  });
}
"""
"""Sideways arrows move a focused slider or else step frames, and never the camera; space plays and
pauses, also just after a button was clicked (Firefox would click that again when the key comes up)."""

ONE_PIXEL: Final = "data:image/gif;base64,R0lGODlhAQABAAAAACH5BAEKAAEALAAAAAABAAEAAAICTAEAOw=="

KEYS: Final = f'<img src="{ONE_PIXEL}" hidden onload="{escape(_SCRIPT)}">'
