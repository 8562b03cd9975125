"""Number boxes enforce their limits, whatever is typed into them.

Tests app/ui/widgets.py.
"""

import ast
import asyncio
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import viser

from app.slam.errors import HemislamError
from app.ui.viser_adapter import Bridge
from app.ui.widgets import add_command, by_user, chart, limited
from tests.ui.conftest import BusyThreads, Wire, browser_sends

APP = Path(__file__).parents[2] / "app"


@pytest.mark.parametrize(("typed", "taken"), [(-1, 4), (3, 4), (4, 4), (77, 77), (201, 200)])
def test_a_number_beyond_the_limits_reaches_no_callback_and_the_box_shows_the_nearest(
    server: viser.ViserServer, wire: Wire, busy: BusyThreads, typed: int, taken: int
) -> None:
    box = limited(server.gui.add_number("neighbours", 20, min=4, max=200, step=1))
    seen: list[Any] = []
    box.on_update(by_user(lambda value, _: seen.append(value)))
    wire.clear()
    browser_sends(server, box, typed)
    busy.catch_up()
    assert seen == [taken] and box.value == taken and isinstance(box.value, int)
    shown = [message.updates["value"] for message in wire.messages if type(message).__name__ == "GuiUpdateMessage"]
    assert shown[-1] == taken


def test_each_of_three_numbers_has_its_limits_and_one_without_an_end_is_open_there(
    server: viser.ViserServer, busy: BusyThreads
) -> None:
    size = limited(server.gui.add_vector3("size (m)", (1.0, 1.0, 1.0), min=(0.05, 0.05, 0.05), max=(9.0, 9.0, 9.0)))
    browser_sends(server, size, (0.0, 2.0, 10.0))
    assert size.value == (0.05, 2.0, 9.0)
    place = limited(server.gui.add_number("keyframe", 0, min=0))
    for typed, taken in ((-5, 0), (123_456, 123_456)):
        browser_sends(server, place, typed)
        assert place.value == taken


def test_every_box_with_limits_keeps_to_them() -> None:
    found, kept = set(), set()
    for path in (APP / "ui").rglob("*.py"):
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            match call:
                case ast.Call(func=ast.Attribute(attr="add_number" | "add_vector3"), keywords=options):
                    if {option.arg for option in options} & {"min", "max"}:
                        found.add(f"{path.relative_to(APP)}:{call.lineno}")
                case ast.Call(func=ast.Name(id="limited"), args=[ast.Call() as box]):
                    kept.add(f"{path.relative_to(APP)}:{box.lineno}")
    assert len(found) > 10 and found == kept


def test_a_command_that_finds_nothing_to_do_says_so_where_it_was_given(server: viser.ViserServer) -> None:
    told: list[str] = []
    client: Any = SimpleNamespace(add_notification=lambda _title, text, **_: told.append(text))

    def act(given_by: Any) -> None:
        if given_by is client:
            raise HemislamError("There is no fork; fork first.")

    add_command(server.gui, "Swap A and its fork B", act, hotkey="X")
    (command,) = [c for c in server.gui._command_handle_from_uuid.values() if c.hotkey == "X"]
    for callback in command._impl.trigger_cb:
        callback(viser.CommandEvent(client=client, client_id=0, target=command))
    assert told == ["There is no fork; fork first."]


def test_what_the_system_refuses_is_shown_as_a_sentence(server: viser.ViserServer) -> None:
    told: list[str] = []
    client: Any = SimpleNamespace(add_notification=lambda _title, text, **_: told.append(text))

    def act(_: object, __: object) -> None:
        Path("n" * 300).exists()

    event: Any = SimpleNamespace(client=client, target=SimpleNamespace(value=1))
    with ThreadPoolExecutor(1) as thread:  # in that of a test of a browser a loop runs already
        thread.submit(asyncio.run, by_user(act)(event)).result()
    assert len(told) == 1 and told[0].startswith("The system refused: File name too long (nnn")


def test_a_chart_of_tiny_values_is_not_magnified_beyond_what_its_ticks_can_say(server: viser.ViserServer) -> None:
    """Ticks have at most three decimals: those of a smaller range would all read 0."""
    drawn: Any = chart(server.gui, [{}])
    assert drawn.scales["y"]["range"]["max"] == {"pad": 0.1, "soft": 0.01, "mode": 1}


def test_each_word_of_the_page_is_heard_once_however_late_the_threads_are(
    server: viser.ViserServer, busy: BusyThreads
) -> None:
    heard: list[str] = []
    bridge = Bridge(server.gui, "transport", lambda word, _: heard.append(word))
    for sent in ("step 1 #1ab", "speed 2× #2cd"):
        browser_sends(server, bridge._field, sent)
    busy.catch_up()
    assert heard == ["step 1", "speed 2×"]
