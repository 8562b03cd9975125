"""A Foxglove server of a few topics, to play a recording out to a program that speaks that protocol."""

import contextlib
import json
import threading
import time
from contextlib import AbstractContextManager

from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

from app.sensors.live.foxglove import MAX_MESSAGE, MESSAGE, SUBPROTOCOLS, Channel
from app.slam.errors import HemislamError


class FoxgloveServer(AbstractContextManager["FoxgloveServer"]):
    """Serves on threads of its own; `publish` waits for slow clients.

    Attributes:
        port: the port on which it listens; 0 asks for any free port.

    Raises:
        HemislamError: the port is taken.
    """

    def __init__(self, host: str, port: int, channels: list[Channel]) -> None:
        self._channels = channels
        self._clients: dict[ServerConnection, dict[int, int]] = {}  # channel to the number that the client gave it
        try:
            self._server = serve(
                self._meet, host, port, subprotocols=SUBPROTOCOLS, max_size=MAX_MESSAGE, compression=None,
                close_timeout=1.0,
            )  # fmt: skip
        except OSError as error:
            raise HemislamError(f"Port {port} on {host} cannot be opened ({error.strerror}); choose another.") from None
        self.port = int(self._server.socket.getsockname()[1])
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True, name="foxglove-server")
        self._thread.start()

    def publish(self, channel: int, log_ns: int, data: bytes) -> None:
        """Send to every client that asked for the channel, by its id."""
        for connection, subscriptions in list(self._clients.items()):
            if (number := subscriptions.get(channel)) is not None:
                with contextlib.suppress(ConnectionClosed):  # its thread removes it
                    connection.send(MESSAGE.pack(1, number, log_ns) + data)

    def wait_for_subscribers(self, timeout_s: float) -> bool:
        """Wait at most this long for a client that has asked for every topic. Returns whether there is one."""
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            if any(len(subscriptions) == len(self._channels) for subscriptions in list(self._clients.values())):
                return True
            time.sleep(0.01)
        return False

    def close(self) -> None:
        self._server.shutdown()
        for connection in list(self._clients):
            connection.close()
        self._thread.join(5.0)

    def __exit__(self, *_: object) -> None:
        self.close()

    def _meet(self, connection: ServerConnection) -> None:
        """Serve one client, on its own thread, until it leaves."""
        info = {"op": "serverInfo", "name": "hemislam feed", "capabilities": [], "supportedEncodings": ["cdr"]}
        channels = [
            {
                "id": channel.id, "topic": channel.topic, "encoding": channel.encoding, "schemaName": channel.type,
                "schema": channel.definition, "schemaEncoding": "ros2msg",
            }
            for channel in self._channels
        ]  # fmt: skip
        self._clients[connection] = {}
        try:
            connection.send(json.dumps(info))
            connection.send(json.dumps({"op": "advertise", "channels": channels}))
            for message in connection:
                if isinstance(message, str):
                    _note(message, self._clients[connection])
        except ConnectionClosed:
            return
        finally:
            del self._clients[connection]


def _note(text: str, subscriptions: dict[int, int]) -> None:
    """Note what a client subscribes to, or no longer wants."""
    try:
        said = json.loads(text)
        if said["op"] == "subscribe":
            asked = {int(s["channelId"]): int(s["id"]) for s in said["subscriptions"]}
            subscriptions.update({channel: number for channel, number in asked.items() if 0 <= number < 1 << 32})
        elif said["op"] == "unsubscribe":
            for channel in [c for c, number in subscriptions.items() if number in said["subscriptionIds"]]:
                del subscriptions[channel]
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError):  # not of this protocol
        return
