"""The assumptions of `app.ui.viser_adapter` on viser's page. If an upgrade breaks one, a sentence says what fails.

Tests app/ui/viser_adapter.py.
"""

from pathlib import Path

import pytest
import viser

from app.ui.html import source
from app.ui.viser_adapter import Bridge, page_parts
from tests.ui.conftest import Wire, user_sets

CLIENT = Path(viser.__file__).parent / "client" / "src"

ASSUMPTIONS = {
    "HTML elements are no longer inserted as they are, so the page's script does not run.": (
        "components/Html.tsx",
        "return <div dangerouslySetInnerHTML={{ __html: props.content }} />;",
    ),
    "A container's elements are no longer siblings: a bridge does not find the text field before it.": (
        "ControlPanel/Generated.tsx",
        'return <Box pt="xs">{children}</Box>;',
    ),
    "A container's elements are no longer in the order in which they were added.": (
        "ControlPanel/Generated.tsx",
        "(a, b) => a.order - b.order,",
    ),
    "A text field is no longer an input whose changes are sent: clicks on the page's HTML do not arrive.": (
        "components/TextInput.tsx",
        'size="xs"\n          onChange={(value) => {\n            setValue(uuid, value.target.value);',
    ),
    "An input is no longer wrapped in one box: the hidden text field of a bridge becomes visible.": (
        "components/common.tsx",
        '<Box pb="0.5em" px="xs">\n      {children}\n    </Box>',
    ),
    "The camera no longer listens to keys on the document: arrows may move it and step frames at once.": (
        "CameraControls.tsx",
        'document.addEventListener("keydown", onKeyDown);',
    ),
    "Hotkeys are no longer Mantine's, which listen on the html element: arrows in a slider may step frames.": (
        "CommandPalette.tsx",
        "useHotkeys(hotkeyItems);",
    ),
    "The docked panel is no longer closed by such a chevron: closing it takes the bar off the page.": (
        "dock/handles.tsx",
        'attrs={{ "data-dock-region-collapse": edge }}',
    ),
    "The scene is no longer inset so: it leaves room for a closed panel.": (
        "dock/DockManager.tsx",
        "right: rightInset,",
    ),
    "Dock tabs no longer carry data-dock-tab: the tabs are no grid.": (
        "dock/TabGroupFrame.tsx",
        "data-dock-tab={paneId}",
    ),
    "A phone's panel is no longer styled so: it covers the transport.": (
        "ControlPanel/BottomPanel.tsx",
        'maxHeight: "60%",\n            width: "20em",',
    ),
    "The head of a phone's panel is no longer styled so: it takes the room of the tabs.": (
        "ControlPanel/BottomPanel.tsx",
        'cursor: "pointer",\n        position: "relative",',
    ),
    "A folder is no longer a bordered Paper: folded ones look like empty boxes.": (
        "components/Folder.tsx",
        "<Paper\n      withBorder",
    ),
    "The head of a folder is no longer a Paper to click: the keyboard does not open it.": (
        "components/Folder.tsx",
        'cursor: isEmpty ? undefined : "pointer",\n        }}\n        onClick={toggle}',
    ),
    "Tooltips are no longer Mantine's: they cover the controls around.": (
        "components/common.tsx",
        "<Tooltip\n          zIndex={100}",
    ),
    "A number box is no longer Mantine's: it acts on each keystroke.": (
        "components/NumberInput.tsx",
        'import { NumberInput } from "@mantine/core";',
    ),
    "A button is no longer Mantine's: a click loses what was just typed, and Enter does nothing in a dialog.": (
        "components/Button.tsx",
        'import { Button } from "@mantine/core";',
    ),
    "A button's component no longer gets its whole message: its hint is not shown.": (
        "ControlPanel/Generated.tsx",
        "return <ButtonComponent {...conf} />;",
    ),
    "Panels are no longer dimmed while the server is lost: nothing says so in words.": (
        "ControlPanel/Generated.tsx",
        'pointerEvents: connected ? undefined : "none",\n        transition: "opacity 150ms ease",',
    ),
    "A slider no longer has a track and a number box side by side: the box may cut long numbers off.": (
        "components/Slider.tsx",
        '<Flex justify="space-between">\n      <Slider',
    ),
}


@pytest.mark.parametrize("sentence", ASSUMPTIONS)
def test_viser_s_page_is_built_as_the_adapter_assumes(sentence: str) -> None:
    file, text = ASSUMPTIONS[sentence]
    path = CLIENT / file
    assert path.is_file() and text in path.read_text(encoding="utf-8"), f"{sentence} (viser's {file} has changed.)"


def test_a_bridge_is_a_text_field_followed_by_its_mark(server: viser.ViserServer, wire: Wire) -> None:
    words: list[str] = []
    bridge = Bridge(server.gui, "test", lambda word, _: words.append(word))
    kinds = [(type(message).__name__, message.props.order) for message in wire.messages if hasattr(message, "props")]
    (field, first), (mark, second) = kinds
    assert (field, mark) == ("GuiTextMessage", "GuiHtmlMessage") and first < second
    assert 'class="hs-bridge" data-name="test"' in wire.messages[-1].props.content
    user_sets(bridge._field, "choose 3 5 #17ab")
    user_sets(bridge._field, "delete 0 door #2 #27cd")
    assert words == ["choose 3 5", "delete 0 door #2"]
    assert 'data-hs-to="test"' in bridge.live("<b>x</b>")


def test_the_page_s_scripts_and_styles_are_in_it_and_cannot_end_their_element_early() -> None:
    parts, names = page_parts(["1×"]), ("viser_adapter", "transport", "tour", "drop")
    for name in ("style.css", "viser_adapter.css", *(f"{name}.js" for name in names)):
        assert source(name) in parts
        assert not any(end in source(name) for end in ("</style", "</script", "</body"))
    assert parts.index("hs-dock") < parts.index("<script")


PRIVATE = ("._impl", "._websock", "._gui_", "_broadcast_buffer", "mantine", "viser._")


def test_nothing_else_of_the_page_touches_private_parts_of_viser() -> None:
    folder = Path(__file__).parents[2] / "app" / "ui"
    used = {
        f"{path.relative_to(folder)}: {name}"
        for path in folder.rglob("*")
        if path.is_file()
        and path.suffix in (".py", ".js", ".css", ".html")
        and not path.name.startswith("viser_adapter")
        for name in PRIVATE
        if name in path.read_text(encoding="utf-8")
    }
    assert used == set()
