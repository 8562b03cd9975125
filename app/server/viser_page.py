"""viser behind our own port: its server on a loopback port that only we can use, its page, and the bridge."""

import asyncio
import contextlib
import io
import secrets
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import viser
import viser._messages
import websockets.asyncio.server
from starlette.websockets import WebSocket, WebSocketDisconnect
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.typing import Subprotocol

from app.server.access import MOST_BYTES

KEY_HEADER = "X-Hemislam-Key"

HARMLESS = frozenset({"ViewerCameraMessage"})
"""What the page of somebody who may look only can say to viser: where its own camera is."""

MOST_UPLOADS = 4
"""That one browser may have under way."""

BUFFER_BYTES = 1 << 20
"""Of each socket on the way to the browser. The system would let tens of megabytes of old frames queue there."""

MOST_AT_ONCE = 32
"""Updates in one message to a page: a frame with its keyframe and some clouds that were thinned, which belong together.

A message is held half a dozen times on its way, for each page; viser by itself puts 128 in one.
"""


@dataclass(frozen=True, slots=True)
class Viser:
    """A running viser server and what is needed to reach it."""

    server: viser.ViserServer
    key: str

    @property
    def address(self) -> tuple[str, int]:
        return "127.0.0.1", self.server.get_port()

    @property
    def url(self) -> str:
        return "ws://{}:{}/".format(*self.address)

    def stop(self) -> None:
        with contextlib.redirect_stdout(io.StringIO()):  # it has its own words for that
            self.server.stop()


def start_viser() -> Viser:
    """Start viser on a free loopback port that answers to nobody but our bridge.

    By itself viser accepts any Origin, so any web page that the user has open could drive it, and
    any of them could ask for the public share tunnel.
    """
    key = secrets.token_urlsafe(24)
    with _keyed(key), contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    server._websock_server.unregister_handler(viser._messages.ShareUrlRequest)
    server._websock_server.unregister_handler(viser._messages.ShareUrlDisconnect)
    server._websock_server._broadcast_buffer.max_window_size = MOST_AT_ONCE
    return Viser(server, key)


@contextlib.contextmanager
def _keyed(key: str) -> Iterator[None]:
    """WebSocket servers started meanwhile refuse requests without the key, which no browser can send."""
    serve = websockets.asyncio.server.serve

    def keyed_serve(*args: Any, **kwargs: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            if not secrets.compare_digest("".join(request.headers.get_all(KEY_HEADER)), key):
                return connection.respond(403, "Only hemislam itself talks to this port.\n")
            return None

        return serve(*args, **kwargs | {"process_request": check})

    websockets.asyncio.server.serve = keyed_serve  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]


def page_html() -> str:
    """viser's client: one file that holds everything."""
    page = Path(viser.__file__).parent / "client" / "build" / "index.html"
    return page.read_text(encoding="utf-8").replace("<title>Viser</title>", "<title>hemislam</title>", 1)


BADGE = (
    '<div style="position:fixed;left:50%;top:8px;transform:translateX(-50%);z-index:9999;pointer-events:none;'
    'padding:2px 12px;border-radius:12px;background:#ffb020;color:#10151c;font:600 12px system-ui,sans-serif">'
    "Looking only: what you press here does nothing</div>"
)


def viewer_html(page: str) -> str:
    """The same page for somebody who may look only, and is told so."""
    head, body, rest = page.rpartition("</body>")
    return f"{head}{BADGE}{body}{rest}"


class Refused(Exception):
    """What a browser sent is not for us. code: to close the WebSocket with."""

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(reason)
        self.code, self.reason = code, reason


class Gate:
    """What of a browser's messages may reach viser. viewer: whether it may look only."""

    def __init__(self, *, viewer: bool) -> None:
        self._viewer = viewer
        self._uploads: dict[str, int] = {}

    def let(self, raw: bytes) -> bytes | None:
        """The message, or None if it is to be left out.

        It is written anew, so that viser can not read anything else in it than was read here.

        Raises:
            Refused: it is no message, or an upload that is too large.
        """
        try:
            message = msgspec.msgpack.decode(raw, type=dict[str, Any])
        except msgspec.MsgspecError:
            raise Refused(1007, "That is no message of the page.") from None
        kind = message.get("type")
        if self._viewer and kind not in HARMLESS:
            return None
        if kind == "FileTransferStartUpload":
            self._begin(message)
        elif kind == "FileTransferPart" and not self._take(message):
            return None
        return msgspec.msgpack.encode(message)

    def _begin(self, message: dict[str, Any]) -> None:
        size = message.get("size_bytes")
        if not isinstance(size, int) or not 0 <= size <= MOST_BYTES:
            raise Refused(1009, f"Files larger than {MOST_BYTES >> 10} kB are not taken.")
        if len(self._uploads) >= MOST_UPLOADS:
            raise Refused(1008, "Too many uploads at once.")
        if size:
            self._uploads[str(message.get("transfer_uuid"))] = size

    def _take(self, message: dict[str, Any]) -> bool:
        """Whether a part belongs to an upload, of which it must not be more than was told."""
        name, content = str(message.get("transfer_uuid")), message.get("content")
        if name not in self._uploads or not isinstance(content, bytes) or not content:
            return False  # parts of no bytes would pile up without end
        self._uploads[name] -= len(content)
        if self._uploads[name] < 0:
            raise Refused(1009, "The file is larger than was told.")
        if self._uploads[name] == 0:
            del self._uploads[name]
        return True


async def bridge(browser: WebSocket, target: Viser, *, viewer: bool = False) -> None:
    """Pass messages between a browser and viser until either leaves; of a viewer's only harmless ones.

    Each direction takes a message only when the one before was delivered, so a slow browser slows
    viser's sending, and viser then sends it fewer, newer updates.
    """
    pipe = socket.socket(proto=socket.IPPROTO_TCP)  # as `listen`
    pipe.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
    pipe.setblocking(False)
    try:
        await asyncio.get_running_loop().sock_connect(pipe, target.address)
        upstream = await connect(
            target.url,
            sock=pipe,
            subprotocols=[Subprotocol(name) for name in browser.scope["subprotocols"]] or None,
            additional_headers={KEY_HEADER: target.key},
            proxy=None,
            compression=None,
            max_size=None,
            max_queue=1,
            ping_interval=None,
        )
    except (OSError, InvalidHandshake, TimeoutError):
        pipe.close()
        await browser.close(1013, "The page's server is not there.")
        return
    async with upstream:
        await browser.accept(subprotocol=upstream.subprotocol)
        ways = [
            asyncio.create_task(_up(browser, upstream, Gate(viewer=viewer))),
            asyncio.create_task(_down(browser, upstream)),
        ]
        try:
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for way in ways:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)


async def _up(browser: WebSocket, upstream: ClientConnection, gate: Gate) -> None:
    with contextlib.suppress(WebSocketDisconnect, ConnectionClosed):
        try:
            while True:
                received = await browser.receive()
                if received["type"] == "websocket.disconnect":
                    return
                if (message := gate.let(received.get("bytes") or b"")) is not None:
                    await upstream.send(message)
        except Refused as refused:
            await browser.close(refused.code, refused.reason)


async def _down(browser: WebSocket, upstream: ClientConnection) -> None:
    with contextlib.suppress(WebSocketDisconnect):
        try:
            while True:
                message = await upstream.recv(decode=False)
                await browser.send_bytes(message)
        except ConnectionClosed as closed:
            code, reason = (closed.rcvd.code, closed.rcvd.reason) if closed.rcvd else (1001, "")
            await browser.close(code if code not in (1005, 1006) else 1000, reason)
