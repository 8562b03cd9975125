"""A Foxglove server of two topics, to play a recording out to whoever speaks that protocol."""

import asyncio
import json
import threading
import time
from collections.abc import Coroutine
from dataclasses import dataclass, field
from typing import Any, Self

from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed

from app.sensors.live.foxglove import MAX_MESSAGE, MESSAGE, SUBPROTOCOLS
from app.slam.errors import HemislamError


@dataclass(frozen=True, slots=True)
class Offer:
    """A topic to be announced. type: its ROS type. definition: the type's text."""

    topic: str
    type: str
    definition: str


@dataclass(eq=False, slots=True)
class _Client:
    connection: ServerConnection
    subscriptions: dict[int, int] = field(default_factory=dict)
    """Channel to the client's number for it."""


class FoxgloveServer:
    """Runs on a thread of its own; `publish` waits for slow clients. A context manager.

    Attributes:
        port: where it listens, once made; 0 asks for any.

    Raises:
        HemislamError: the port is taken.
    """

    def __init__(self, host: str, port: int, offers: list[Offer]) -> None:
        self._offers = offers
        self._clients: set[_Client] = set()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True, name="foxglove-server")
        self._thread.start()
        try:
            self._server = self._run(self._serve(host, port))
        except OSError as error:
            self._end()
            raise HemislamError(f"Port {port} on {host} can not be opened ({error.strerror}).") from None
        self.port = int(next(iter(self._server.sockets)).getsockname()[1])

    def publish(self, channel: int, log_ns: int, data: bytes) -> None:
        """Send to every client that asked for the channel (its place among the offers)."""
        self._run(self._send(channel, log_ns, data))

    def wait_for_subscribers(self, timeout_s: float) -> bool:
        """Until some client has asked for every topic."""
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            if any(len(client.subscriptions) == len(self._offers) for client in list(self._clients)):
                return True
            time.sleep(0.01)
        return False

    def close(self) -> None:
        self._run(self._close())
        self._end()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _run(self, work: Coroutine[Any, Any, Any]) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result()

    def _end(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(5.0)
        self._loop.close()

    async def _serve(self, host: str, port: int) -> Any:
        return await serve(
            self._meet, host, port, subprotocols=SUBPROTOCOLS, max_size=MAX_MESSAGE, compression=None, close_timeout=1.0
        )

    async def _close(self) -> None:
        self._server.close()
        await self._server.wait_closed()

    async def _meet(self, connection: ServerConnection) -> None:
        info = {"op": "serverInfo", "name": "hemislam feed", "capabilities": [], "supportedEncodings": ["cdr"]}
        channels = [
            {
                "id": number, "topic": offer.topic, "encoding": "cdr", "schemaName": offer.type,
                "schema": offer.definition, "schemaEncoding": "ros2msg",
            }
            for number, offer in enumerate(self._offers)
        ]  # fmt: skip
        client = _Client(connection)
        self._clients.add(client)
        try:
            await connection.send(json.dumps(info))
            await connection.send(json.dumps({"op": "advertise", "channels": channels}))
            async for message in connection:
                if isinstance(message, str):
                    _note(message, client)
        except ConnectionClosed:
            pass
        finally:
            self._clients.discard(client)

    async def _send(self, channel: int, log_ns: int, data: bytes) -> None:
        for client in list(self._clients):
            number = client.subscriptions.get(channel)
            if number is not None:
                try:
                    await client.connection.send(MESSAGE.pack(1, number, log_ns) + data)
                except ConnectionClosed:
                    self._clients.discard(client)


def _note(text: str, client: _Client) -> None:
    """What a client asks for, or no longer."""
    try:
        said = json.loads(text)
        if said["op"] == "subscribe":
            client.subscriptions.update({int(s["channelId"]): int(s["id"]) for s in said["subscriptions"]})
        elif said["op"] == "unsubscribe":
            gone = set(said["subscriptionIds"])
            client.subscriptions = {c: n for c, n in client.subscriptions.items() if n not in gone}
    except (ValueError, KeyError, TypeError):  # not of this protocol
        return
