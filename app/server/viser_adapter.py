"""Everything in app/ that depends on viser's internals.

`tests/server/test_adapters.py` shows what an upgrade of viser has changed, and that no other module uses internals.
"""

import contextlib
import io
import math
import secrets
import warnings
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import msgspec
import viser
import viser._icons
import viser._messages
import viser.infra
import websockets.asyncio.server

from app.export.point_sizes import with_point_sizes

KEY_HEADER: Final = "X-Hemislam-Key"

MOST_AT_ONCE: Final = 32
"""Most updates in one message to a page. viser would send 128, and each message is copied several times per page."""

CLIENT: Final = Path(viser.__file__).parent / "client" / "build" / "index.html"
"""viser's page: one self-contained file."""
TITLE: Final = "<title>Viser</title>"
BODY_END: Final = "</body>"

BADGE: Final = (
    '<div class="hs-view-only" style="position:fixed;left:50%;top:8px;'
    "transform:translateX(-50%);z-index:9999;pointer-events:none;padding:2px 12px;"
    'border-radius:12px;background:#ffb020;color:#10151c;font:600 12px system-ui,sans-serif">'
    "View only: controls have no effect</div>"
)


@dataclass(frozen=True, slots=True)
class Viser:
    """A running viser server. Its port answers only requests that carry `key` in the header `KEY_HEADER`."""

    server: viser.ViserServer
    key: str

    @property
    def address(self) -> tuple[str, int]:
        return "127.0.0.1", self.server.get_port()

    @property
    def url(self) -> str:
        return "ws://{}:{}/".format(*self.address)

    def stop(self) -> None:
        with contextlib.redirect_stdout(io.StringIO()):  # viser prints when it stops
            self.server.stop()


def start_viser() -> Viser:
    """Start viser on a free loopback port that answers only to our bridge.

    viser itself accepts every Origin, so any web page open in the user's browser could control it.
    """
    key = secrets.token_urlsafe(24)
    warnings.filterwarnings("ignore", r"Queued a \w+ on a closed connection")  # a page may disconnect at any moment
    _list_icons_once()
    with _require_key(key), contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    server._websock_server.get_message_buffer().max_window_size = MOST_AT_ONCE
    return Viser(server, key)


def _list_icons_once() -> None:
    """Read viser's list of 4,000 icons once. viser reads it for each icon, which takes most of a page's build time."""
    icons = zipfile.ZipFile(viser._icons.ICONS_DIR / "tabler-icons.zip")
    viser._icons.zipfile = SimpleNamespace(ZipFile=lambda path: contextlib.nullcontext(icons))  # type: ignore[assignment,attr-defined]


@contextlib.contextmanager
def _require_key(key: str) -> Iterator[None]:
    """While this context is active, a WebSocket server started by viser refuses requests without the key.

    viser has no option for this, so websockets' `serve` is replaced until viser has called it. A browser cannot send
    the header.
    """
    serve = websockets.asyncio.server.serve

    def serve_with_key(handler: Any, *args: Any, **kwargs: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            if not secrets.compare_digest("".join(request.headers.get_all(KEY_HEADER)), key):
                return connection.respond(403, "Only hemislam itself talks to this port.\n")
            return None

        if handler.__module__.startswith("viser."):
            kwargs["process_request"] = check
        return serve(handler, *args, **kwargs)

    websockets.asyncio.server.serve = serve_with_key  # type: ignore[assignment,misc]  # mypy knows it as a class
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]


def is_readable(kind: str, raw: bytes) -> bool:
    """Whether viser can handle a message of a page. For an unreadable message, it would log a traceback.

    Args:
        kind: type stated in the message. raw: the whole message as msgpack.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            read = viser.infra.Message.deserialize(raw)
        if kind != "ViewerCameraMessage":
            return True
        camera = vars(msgspec.convert(vars(read), viser._messages.ViewerCameraMessage, strict=True))
    except Exception:  # a message with arbitrary content may cause any error
        return False
    numbers = [n for value in camera.values() for n in (value if isinstance(value, tuple) else (value,))]
    return all(isinstance(n, int | float) and math.isfinite(n) and abs(n) < 1e12 for n in numbers)


def page_html(*parts: str) -> str:
    """viser's page with our title, our limits on point sizes, and parts at the end of its body."""
    page = with_point_sizes(CLIENT.read_text(encoding="utf-8")).replace(TITLE, "<title>hemislam</title>", 1)
    head, body_end, rest = page.rpartition(BODY_END)
    return f"{head}{''.join(parts)}{body_end}{rest}"
