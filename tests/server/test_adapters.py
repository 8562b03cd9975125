"""Contracts with libraries: only adapters use private names, and the tests report changes by an upgrade.

Tests app/server/viser_adapter.py.
"""

import ast
import warnings
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import get_type_hints

import pytest
import viser
import viser._icons
import viser._messages
import websockets.asyncio.server
from server_site import CAMERA, PROTOCOL, packed, until
from viser.infra import WebsockServer
from websockets.sync.client import connect

from app.server import viser_adapter
from app.server.bridge import NEVER, VIEWER_MESSAGES
from app.server.viser_adapter import Viser

APP = Path(viser_adapter.__file__).resolve().parents[1]

ADAPTERS = {"server/viser_adapter.py"}
"""Modules that may use private names of a library."""

PUBLIC = {"os._exit"}
"""Documented, whatever its name looks like."""


# --- outside the adapters ------------------------------------------------------------------------
def private_uses(source: str) -> Iterator[str]:
    """Uses of private names that the module itself does not define."""
    tree = ast.parse(source)
    own = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute) and _is_self(node.value)}
    own |= {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    own |= {node.target.id for node in ast.walk(tree) if isinstance(node, ast.AnnAssign) and _is_name(node.target)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and _is_private(node.attr):
            mangled = "__" in node.attr[1:]  # _Class__name
            if (mangled or (node.attr not in own and not _is_self(node.value))) and ast.unparse(node) not in PUBLIC:
                yield f"line {node.lineno}: {ast.unparse(node)}"
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in ("getattr", "setattr", "hasattr", "delattr"):
            name = node.args[1]
            if isinstance(name, ast.Constant) and _is_private(str(name.value)) and name.value not in own:
                yield f"line {node.lineno}: {ast.unparse(node)}"
        elif isinstance(node, ast.Import | ast.ImportFrom):
            modules = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            modules += [alias.name for alias in node.names]
            if any(_is_private(part) for module in modules for part in module.split(".")):
                yield f"line {node.lineno}: {ast.unparse(node)}"


def _is_private(name: str) -> bool:
    return name.startswith("_") and not name.endswith("__")


def _is_name(node: ast.expr) -> bool:
    return isinstance(node, ast.Name)


def _is_self(node: ast.expr) -> bool:
    return isinstance(node, ast.Name) and node.id in ("self", "cls")


@pytest.mark.parametrize(
    "source",
    [
        "handle._impl.props",
        "self.field._impl.uuid",
        "writer._Writer__chunk_indices = []",
        "self._mcap._Writer__chunk_indices = []",
        "getattr(handle, '_impl')",
        "import viser._messages",
        "from viser.infra import _infra",
        "from uvicorn._types import Scope",
    ],
)
def test_a_private_use_is_recognised(source: str) -> None:
    assert list(private_uses(source))


@pytest.mark.parametrize(
    "source",
    ["self._mine", "import os\nos._exit(1)", "x.__class__", "class A:\n  def f(self, o): return self._a + o._a"],
)
def test_own_names_are_not_private_uses(source: str) -> None:
    assert not list(private_uses(source))


def test_no_module_but_the_adapters_uses_private_names_of_a_library() -> None:
    found = {
        f"app/{path}, {use}"
        for file in sorted(APP.rglob("*.py"))
        if (path := file.relative_to(APP).as_posix()) not in ADAPTERS
        for use in private_uses(file.read_text(encoding="utf-8"))
    }
    assert not found, f"Private names of a library are used outside of the adapters {ADAPTERS}: {sorted(found)}"


# --- viser ---------------------------------------------------------------------------------------
def test_viser_calls_the_serve_that_the_adapter_replaces() -> None:
    """That strangers are refused is tested in `test_web.py`; this names the cause when they are not."""
    source = Path(viser.infra.__file__).with_name("_infra.py")
    assert source.exists() and "websockets.asyncio.server.serve(" in source.read_text(), (
        "viser no longer starts its server by `websockets.asyncio.server.serve`, so `viser_adapter._require_key` does"
        " not close its port to strangers; find out how it starts now."
    )
    assert callable(websockets.asyncio.server.serve)


def test_viser_has_the_websocket_server_that_the_adapter_configures(target: Viser) -> None:
    server = getattr(target.server, "_websock_server", None)
    assert isinstance(server, WebsockServer), "ViserServer has no `_websock_server`; see `viser_adapter.start_viser`."
    buffer = server.get_message_buffer()
    assert "max_window_size" in get_type_hints(type(buffer)), (
        "viser's message buffer has no `max_window_size`, so `viser_adapter.MOST_AT_ONCE` has no effect."
    )
    assert buffer.max_window_size == viser_adapter.MOST_AT_ONCE


def test_a_page_that_leaves_while_its_camera_moves_is_no_warning_in_the_log() -> None:
    with warnings.catch_warnings(record=True) as told:
        running = viser_adapter.start_viser()
        headers = {viser_adapter.KEY_HEADER: running.key}
        with connect(running.url, subprotocols=[PROTOCOL], additional_headers=headers, proxy=None) as browser:
            browser.send(packed(**CAMERA))
            until(lambda: bool(running.server.get_clients()))
            (client,) = running.server.get_clients().values()
        until(lambda: not running.server.get_clients())
        client.camera.position = (1.0, 2.0, 3.0)
        running.stop()
    assert not [str(one.message) for one in told if issubclass(one.category, UserWarning)]


def test_visers_page_has_what_the_adapter_replaces() -> None:
    assert viser_adapter.CLIENT.is_file(), f"viser's page is not at {viser_adapter.CLIENT}; see `viser_adapter.CLIENT`."
    page = viser_adapter.CLIENT.read_text(encoding="utf-8")
    for part in (viser_adapter.TITLE, viser_adapter.BODY_END):
        assert part in page, f"viser's page has no {part}; the title or the view-only badge will be missing."


def test_parts_of_ours_are_at_the_end_of_the_body_of_visers_page() -> None:
    page = viser_adapter.page_html("<b>ours</b>", viser_adapter.BADGE)
    assert page.partition(f"</div>\n  <b>ours</b>{viser_adapter.BADGE}</body>")[2].strip() == "</html>"


@pytest.mark.parametrize("name", sorted(NEVER | VIEWER_MESSAGES | {"FileTransferStartUpload", "FileTransferPart"}))
def test_viser_has_the_messages_that_the_bridge_decides_about(name: str) -> None:
    assert hasattr(viser._messages, name), (
        f"viser has no message {name}; look how `bridge.Gate` must treat its successor."
    )


def test_a_server_lists_the_archive_of_icons_once(target: Viser, monkeypatch: pytest.MonkeyPatch) -> None:
    """viser's own way lists 4,000 files for each icon; the pictures are the same."""
    with zipfile.ZipFile(viser._icons.ICONS_DIR / "tabler-icons.zip") as archive:
        wanted = archive.read("bug.svg").decode()
    monkeypatch.setattr(zipfile.ZipFile, "_RealGetContents", lambda archive: pytest.fail("the list is read again"))
    viser._icons.svg_from_icon.cache_clear()
    assert viser._icons.svg_from_icon(viser.Icon.BUG) == wanted
