"""A WebSocket client that receives the same messages as a browser, and decodes them."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import msgspec.msgpack
import numpy as np
import viser
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

PROTOCOL = f"viser-v{viser.__version__}"


class Client:
    """The received messages.

    Attributes:
        received: bytes so far. heard: monotonic time (s) and content of each message, if messages are kept.
    """

    def __init__(self) -> None:
        self.received = 0
        self.heard: list[tuple[float, bytes]] = []

    def entries(self, first: int = 0) -> Iterator[tuple[float, dict[str, Any]]]:
        """Time and content of the viser messages, from the WebSocket message number `first` on.

        Arrays in the updates of a scene node are flat.
        """
        for at, raw in self.heard[first:]:
            for entry in _decoded(raw):
                yield at, entry


def _decoded(raw: bytes) -> list[dict[str, Any]]:
    """Decode a WebSocket message: zstd-compressed msgpack, then the arrays, each aligned to 8 bytes."""
    end = 16 + int.from_bytes(raw[8:16], "little")
    content = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(raw[16:end]))
    arrays = []
    for size in content["binaryBufferLengths"]:
        begin = -(-end // 8) * 8
        end = begin + size
        arrays.append(raw[begin:end])
    messages: list[dict[str, Any]] = content["messages"]
    for message in messages:
        for name, value in message.get("updates", {}).items():
            if isinstance(value, dict) and "__binary_index" in value:
                message["updates"][name] = np.frombuffer(arrays[value["__binary_index"]], value["dtype"])
    return messages


@contextmanager
def listening(url: str, *, keep: bool = True) -> Iterator[Client]:
    """A client of this server that reads everything. keep: keep the messages."""
    client, ended = Client(), threading.Event()

    def listen() -> None:
        address = url.replace("http", "ws", 1)
        with connect(address, subprotocols=[Subprotocol(PROTOCOL)], max_size=None, proxy=None) as page:
            while not ended.is_set():
                try:
                    raw = page.recv(timeout=0.2)
                except TimeoutError:
                    continue
                except ConnectionClosed:
                    return
                assert isinstance(raw, bytes)
                client.received += len(raw)
                if keep:
                    client.heard.append((time.monotonic(), raw))

    thread = threading.Thread(target=listen)
    thread.start()
    try:
        yield client
    finally:
        ended.set()
        thread.join()
