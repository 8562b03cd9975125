"""How long the server waits for those who talk to it, and for how many: who never ends must not keep others out."""

import asyncio

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

REQUEST_S = 30.0
"""A whole request must be there after so long, however slowly it comes: of the largest one 35 kB/s."""
READ_S = 120.0
"""Of an answer, some tens of kilobytes must be taken in so long."""
MOST_WAITING = 500
"""Connections that have yet to tell what they want; where there are more, the oldest is closed."""


class PatientProtocol(H11Protocol):
    """HTTP with an end to each wait; uvicorn knows only one between two requests."""

    _waiting: dict["PatientProtocol", asyncio.TimerHandle] = {}  # noqa: RUF012  # of all servers, the oldest first
    _unread: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._await_request()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if self.transport.get_protocol() is not self:
            return  # it is a page's WebSocket by now, which may be silent
        if self.conn.their_state in (h11.IDLE, h11.SEND_BODY) and not self.transport.is_closing():
            self._await_request()
        else:
            self._await_no_request()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        self._await_no_request()
        super().handle_websocket_upgrade(event)

    def connection_lost(self, exc: Exception | None) -> None:
        self._await_no_request()
        self.resume_writing()
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        super().pause_writing()
        self._unread = self._unread or self.loop.call_later(READ_S, self.transport.abort)

    def resume_writing(self) -> None:
        super().resume_writing()
        if self._unread is not None:
            self._unread.cancel()
            self._unread = None

    def _await_request(self) -> None:
        if self in self._waiting:
            return
        self._waiting[self] = self.loop.call_later(REQUEST_S, self.transport.abort)
        while len(self._waiting) > MOST_WAITING:
            oldest = next(iter(self._waiting))
            oldest._await_no_request()
            oldest.transport.abort()

    def _await_no_request(self) -> None:
        if (timer := self._waiting.pop(self, None)) is not None:
            timer.cancel()
