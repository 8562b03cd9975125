"""Unused ports, and waiting with a time limit."""

import socket
import time
from collections.abc import Callable

from app.sensors.live.source import Event, LiveSource
from app.slam.types import Measurement


def free(count: int, kind: socket.SocketKind = socket.SOCK_DGRAM) -> list[int]:
    sockets = [socket.socket(socket.AF_INET, kind) for _ in range(count)]
    try:
        for made in sockets:
            made.bind(("127.0.0.1", 0))
        return [made.getsockname()[1] for made in sockets]
    finally:
        for made in sockets:
            made.close()


def collect(source: LiveSource, enough: Callable[[list[Event]], bool], timeout_s: float = 20.0) -> list[Event]:
    """All events until there are enough. Fails after the time-out."""
    events: list[Event] = []
    deadline = time.monotonic() + timeout_s
    while not enough(events):
        assert time.monotonic() < deadline, [e for e in events if not isinstance(e, Measurement)]
        event = source.poll(0.1)
        if event is not None:
            events.append(event)
    return events


def measurements(events: list[Event]) -> list[Measurement]:
    return [event for event in events if isinstance(event, Measurement)]
