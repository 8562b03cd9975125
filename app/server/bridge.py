"""Passes messages between a browser's WebSocket on the public port and viser's WebSocket on its own port."""

import asyncio
import contextlib
import logging
import socket
from typing import Any, Final

import msgspec
from starlette.websockets import WebSocket, WebSocketDisconnect
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.typing import Subprotocol

from app.server.access import MOST_BYTES, MOST_OF_MESSAGE
from app.server.viser_adapter import KEY_HEADER, Viser, is_readable

VIEWER_MESSAGES: Final = frozenset({"ViewerCameraMessage"})
"""The messages that a view-only page may send to viser: the position of its own camera."""
NEVER: Final = frozenset({"ShareUrlRequest", "ShareUrlDisconnect"})
"""Messages that no page may send: they would open viser's public tunnel to this machine."""

PICTURE: Final = "GetRenderResponseMessage"
"""A picture of the scene, requested from the page: the only message that may be large."""
MOST_UPLOADS: Final = 4
"""Most uploads at the same time from one browser."""

BUFFER_BYTES: Final = 1 << 20
"""Send buffer of each socket towards the browser. With the default, tens of megabytes of old frames could queue."""


NO_MESSAGE: Final = "This is not a message of the page."

log = logging.getLogger(__name__)


class Refused(Exception):
    """A browser sent something that ends its connection. code: the WebSocket's close code."""

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(reason)
        self.code, self.reason = code, reason


class Gate:
    """Decides which of a browser's messages reach viser. viewer: the browser has the view-only token."""

    def __init__(self, *, viewer: bool) -> None:
        self._viewer = viewer
        self._uploads: dict[str, int] = {}

    def let(self, raw: bytes) -> bytes | None:
        """The message to pass on, encoded again so that viser reads exactly what was checked; None: drop the message.

        Raises:
            Refused: it is not a message, is too large, or belongs to an upload that is too large.
        """
        try:
            message = msgspec.msgpack.decode(raw, type=dict[str, Any])
            kind = msgspec.convert(message.get("type"), str)
        except (msgspec.MsgspecError, ValueError, RecursionError):
            raise Refused(1007, NO_MESSAGE) from None
        if len(raw) > MOST_OF_MESSAGE and (self._viewer or kind != PICTURE):
            raise Refused(1009, f"A message may have at most {MOST_OF_MESSAGE >> 10} kB.")
        if kind in NEVER or (self._viewer and kind not in VIEWER_MESSAGES):
            return None
        if kind == "FileTransferStartUpload":
            self._begin(message)
        elif kind == "FileTransferPart" and not self._take(message):
            return None
        again = msgspec.msgpack.encode(message)
        if not is_readable(kind, again):
            raise Refused(1007, NO_MESSAGE)
        return again

    def _begin(self, message: dict[str, Any]) -> None:
        size = message.get("size_bytes")
        if not isinstance(size, int) or not 0 <= size <= MOST_BYTES:
            raise Refused(1009, f"A file may have at most {MOST_BYTES >> 10} kB.")
        if len(self._uploads) >= MOST_UPLOADS:
            raise Refused(1008, "Too many uploads at the same time.")
        if size:
            self._uploads[str(message.get("transfer_uuid"))] = size

    def _take(self, message: dict[str, Any]) -> bool:
        """Whether a part belongs to an upload. The parts together must not exceed the announced size."""
        name, content = str(message.get("transfer_uuid")), message.get("content")
        if name not in self._uploads or not isinstance(content, bytes) or not content:
            return False  # empty parts would accumulate without limit
        self._uploads[name] -= len(content)
        if self._uploads[name] < 0:
            raise Refused(1009, "The file is larger than announced.")
        if self._uploads[name] == 0:
            del self._uploads[name]
        return True


async def bridge(browser: WebSocket, target: Viser, *, viewer: bool = False) -> None:
    """Pass messages between a browser and viser until one of them disconnects.

    A message is read after the previous one was delivered, so viser sends a slow browser fewer and newer updates.
    """
    pipe = socket.socket(proto=socket.IPPROTO_TCP)  # asyncio disables Nagle's algorithm only if the protocol is named
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
        await browser.close(1013, "The server of the page is not running.")
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
            log.warning("Closed a page that sent what it must not: %s", refused.reason)
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
