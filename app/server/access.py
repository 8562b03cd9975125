"""Access control, checked for every request and every WebSocket before anything else.

- A page of another site must not reach this server through the user's browser: requests with its Origin are refused.
- On a loopback address there is no token, so the Host must be a loopback name (DNS rebinding).
- On any other address a token is needed: first in the link and then in a cookie, or as a bearer token.
- A second token is view-only. Its requests must be GET, and its page may send only the position of its camera
  (`bridge.py`).
- A request has a limited size, and its body must arrive within a limited time.

To protect the server from hosts that open many connections and send incomplete requests, put a reverse proxy in
front of it (`docs/guide/serving.md`).
"""

import asyncio
import hmac
import ipaddress
import logging
import secrets
from dataclasses import dataclass
from typing import Final
from urllib.parse import quote, urlencode, urlsplit

from fastapi import HTTPException
from starlette.datastructures import MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

RESPONSE_HEADERS: Final = {
    "Content-Security-Policy": "; ".join(
        (
            "default-src 'self'",
            "script-src 'self' 'unsafe-inline' 'unsafe-eval' blob: data:",  # viser's page is one self-unpacking file
            "worker-src 'self' blob: data:",
            "style-src 'self' 'unsafe-inline'",
            "img-src 'self' data: blob:",
            "font-src 'self' data:",
            "connect-src 'self' data: blob:",  # otherwise ?websocket= in the link could send the page to any host
            "object-src 'none'",
            "base-uri 'none'",
            "form-action 'self'",
            "frame-ancestors 'self'",
        )
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}

MOST_BYTES: Final = 1 << 20
"""Maximum size in bytes of a request's body, and of a file uploaded in the page (YAML of a few kilobytes)."""
MOST_OF_MESSAGE: Final = 2 * MOST_BYTES
MOST_OF_PICTURE: Final = 48 * MOST_BYTES
"""Maximum size in bytes of a WebSocket message from a page, and of a picture that the page was asked to render."""
MOST_BYTES_AT_ONCE: Final = 16 * MOST_BYTES
"""Maximum total size in bytes of the bodies of all requests being read or answered."""
BODY_S: Final = 30.0
"""A request's whole body must arrive within this time; the largest body needs 35 kB/s."""

VIEWER: Final = "hemislam.viewer"
"""Key in the scope of requests that came with the view-only token."""

OPEN_PATHS: Final = ("/healthz",)
"""Paths answered without a token: they only say whether the server works."""

log = logging.getLogger(__name__)

_TOO_LARGE: Final = f"A request may have at most {MOST_BYTES >> 10} kB."


def is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True, slots=True)
class Access:
    """The rules for one server.

    Attributes:
        token: the owner's; None on a loopback address. viewer_token: the view-only token; None if there is none.
        secure: whether the server speaks TLS.
    """

    port: int
    token: str | None = None
    viewer_token: str | None = None
    secure: bool = False

    @classmethod
    def on(cls, host: str, port: int, *, secure: bool = False) -> "Access":
        """For a server bound to this address, with new tokens where they are needed."""
        if is_loopback(host):
            return cls(port, secure=secure)
        return cls(port, secrets.token_urlsafe(24), secrets.token_urlsafe(24), secure)

    @property
    def cookie(self) -> str:
        """The cookie's name. It has the port, because browsers send cookies to all ports of a host."""
        return f"hemislam-{self.port}"

    def is_token(self, token: str) -> bool:
        return _same(token, self.token) or _same(token, self.viewer_token)


class Guard:
    """Middleware that applies the rules and adds the headers that bind the browser to them."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app = app
        self._access = access
        self._held = 0  # bytes of request bodies in memory

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and scope["method"] == "HEAD":
            scope = {**scope, "method": "GET"}  # uvicorn still knows the true method and leaves the body out
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
        elif refusal := self._refusal(HTTPConnection(scope)):
            status, reason = refusal
            client, _ = scope.get("client") or ("?", 0)
            path = quote(scope["path"])[:200]  # quoted, it cannot forge a line of the log
            log.warning("Refused %s from %s: %s", path, client, reason, extra={"status": status})
            await _refuse(scope, receive, _with_headers(send), status, reason)
        elif response := self._cookie_response(HTTPConnection(scope)):
            await response(scope, receive, _with_headers(send))
        elif scope["type"] == "http":
            await self._pass_on(scope, receive, _with_headers(send))
        else:
            await self._app(scope, receive, send)

    async def _pass_on(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, limiting the size and the time of its body, whether or not its length was announced."""
        received = 0
        until: float | None = asyncio.get_running_loop().time() + BODY_S

        async def limited() -> Message:
            nonlocal received, until
            try:
                async with asyncio.timeout_at(until):
                    message = await receive()
            except TimeoutError:
                raise HTTPException(408, "The request took too long.", {"Connection": "close"}) from None
            if not message.get("more_body", False):
                until = None  # from here on, wait only for the client to disconnect
            length = len(message.get("body", b""))
            received += length
            self._held += length
            if received > MOST_BYTES:
                raise HTTPException(413, _TOO_LARGE)
            if self._held > MOST_BYTES_AT_ONCE:
                raise HTTPException(503, "Too much is being sent at once; send it again in a moment.")
            return message

        try:
            await self._app(scope, limited, send)
        finally:
            self._held -= received

    def _refusal(self, request: HTTPConnection) -> tuple[int, str] | None:
        """Status and reason if the request must not go on. Marks view-only requests in their scope."""
        host = request.headers.get("host", "")
        if any(_host_of(origin) != host.lower() for origin in request.headers.getlist("origin")):
            return 403, "This page belongs to another site and may not talk to hemislam."
        if refusal := self._refusal_by_token(request, host):
            return refusal
        length = request.headers.get("content-length", "0")
        if not length.isdecimal():
            return 400, "The length of the request is not a number."
        if int(length) > MOST_BYTES:
            return 413, _TOO_LARGE
        return None

    def _refusal_by_token(self, request: HTTPConnection, host: str) -> tuple[int, str] | None:
        scope = request.scope
        if self._access.token is None:
            name = host[: host.rindex("]") + 1] if "]" in host else host.partition(":")[0]
            return None if is_loopback(name) else (403, "Open hemislam as http://127.0.0.1 or http://localhost.")
        given = [
            request.headers.get("authorization", "").removeprefix("Bearer "),
            request.cookies.get(self._access.cookie, ""),
        ]
        if scope["type"] == "http":
            given += request.query_params.getlist("token")
        if scope["path"] in OPEN_PATHS or any(_same(one, self._access.token) for one in given):
            return None
        if not any(_same(one, self._access.viewer_token) for one in given):
            return 401, "Open hemislam by the link that it printed when it started; the token in it is needed once."
        scope[VIEWER] = True
        if scope["type"] == "http" and scope["method"] != "GET":
            return 403, "This link is view only; the other link that hemislam printed lets you control it."
        return None

    def _cookie_response(self, request: HTTPConnection) -> RedirectResponse | None:
        """Move a valid token in the address into a cookie; None if there is no such token."""
        if self._access.token is None or request.scope["type"] != "http" or request.scope["method"] != "GET":
            return None
        token = next(filter(self._access.is_token, request.query_params.getlist("token")), None)
        if token is None:
            return None
        query = urlencode([(name, value) for name, value in request.query_params.multi_items() if name != "token"])
        path = "/" + request.scope["path"].lstrip("/\\")  # "//elsewhere" would lead to another host
        response = RedirectResponse(f"{path}?{query}" if query else path, status_code=303)
        response.set_cookie(self._access.cookie, token, httponly=True, samesite="lax", secure=self._access.secure)
        return response


def _host_of(origin: str) -> str | None:
    """Host and port in an Origin header; None if it is malformed."""
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return None


def _same(given: str, token: str | None) -> bool:
    return token is not None and hmac.compare_digest(given.encode(), token.encode())


async def _refuse(scope: Scope, receive: Receive, send: Send, status: int, reason: str) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": 1008, "reason": reason})
    else:
        await PlainTextResponse(reason + "\n", status)(scope, receive, send)


def _with_headers(send: Send) -> Send:
    async def sender(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            headers.update(RESPONSE_HEADERS)
            headers.setdefault("Cache-Control", "no-store")
        await send(message)

    return sender
