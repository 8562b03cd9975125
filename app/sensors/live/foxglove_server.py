"""A Foxglove server of a few topics, to play a recording out to a program that speaks that protocol."""

import json
import threading
import time
from dataclasses import dataclass, field
from typing import Self

from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

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
    """Serves on threads of its own; `publish` waits for slow clients. A context manager.

    Attributes:
        port: where it listens; 0 asks for any.

    Raises:
        HemislamError: the port is taken.
    """

    def __init__(self, host: str, port: int, offers: list[Offer]) -> None:
        self._offers = offers
        self._clients: set[_Client] = set()
        try:
            self._server = serve(
                self._meet, host, port, subprotocols=SUBPROTOCOLS, max_size=MAX_MESSAGE, compression=None,
                close_timeout=1.0,
            )  # fmt: skip
        except OSError as error:
            raise HemislamError(f"Port {port} on {host} cannot be opened ({error.strerror}).") from None
        self.port = int(self._server.socket.getsockname()[1])
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True, name="foxglove-server")
        self._thread.start()

    def publish(self, channel: int, log_ns: int, data: bytes) -> None:
        """Send to every client that asked for the channel (its place among the offers)."""
        for client in list(self._clients):
            number = client.subscriptions.get(channel)
            if number is not None:
                try:
                    client.connection.send(MESSAGE.pack(1, number, log_ns) + data)
                except ConnectionClosed:
                    self._clients.discard(client)

    def wait_for_subscribers(self, timeout_s: float) -> bool:
        """Whether some client has asked for every topic, at the latest after this time."""
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            if any(len(client.subscriptions) == len(self._offers) for client in list(self._clients)):
                return True
            time.sleep(0.01)
        return False

    def close(self) -> None:
        self._server.shutdown()
        for client in list(self._clients):
            client.connection.close()
        self._thread.join(5.0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _meet(self, connection: ServerConnection) -> None:
        """One client, on its own thread, until it leaves."""
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
            connection.send(json.dumps(info))
            connection.send(json.dumps({"op": "advertise", "channels": channels}))
            for message in connection:
                if isinstance(message, str):
                    _note(message, client)
        except ConnectionClosed:
            return
        finally:
            self._clients.discard(client)


def _note(text: str, client: _Client) -> None:
    """What a client subscribes to, or no longer wants."""
    try:
        said = json.loads(text)
        if said["op"] == "subscribe":
            client.subscriptions.update({int(s["channelId"]): int(s["id"]) for s in said["subscriptions"]})
        elif said["op"] == "unsubscribe":
            gone = set(said["subscriptionIds"])
            client.subscriptions = {c: n for c, n in client.subscriptions.items() if n not in gone}
    except (ValueError, KeyError, TypeError):  # not of this protocol
        return
