"""Who may talk to the server: checked for every request and every WebSocket, before anything else.

- A page of another site must not reach us through the user's browser: its Origin is refused.
- On a loopback address there is no token, so the Host must be a loopback name (DNS rebinding).
- On any other address a token is needed: in the link once, then in a cookie, or as a bearer token.
- There is a second token for those who may look only. Their requests must be GET, and of what their page
  sends the bridge lets through where their camera is (`viser_page.py`): everything else there is a command.
- No request may be larger than what a sensible one is.
"""

import hmac
import ipaddress
import logging
import secrets
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qsl, quote, urlencode, urlsplit

from fastapi import HTTPException
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

CONTENT_SECURITY_POLICY = "; ".join(
    (
        "default-src 'self'",
        "script-src 'self' 'unsafe-inline' 'unsafe-eval' blob: data:",  # viser's page is one file that unpacks itself
        "worker-src 'self' blob: data:",
        "style-src 'self' 'unsafe-inline'",
        "img-src 'self' data: blob:",
        "font-src 'self' data:",
        "connect-src 'self' data: blob:",  # the page would follow ?websocket= to any host
        "object-src 'none'",
        "base-uri 'none'",
        "form-action 'self'",
        "frame-ancestors 'self'",
    )
)

MOST_BYTES = 1 << 20
"""Of a request's body, and of a file that is uploaded in the page: YAML of some kilobytes."""

MOST_BYTES_AT_ONCE = 16 * MOST_BYTES
"""Of the bodies of all requests that are being read or answered."""

VIEWER = "hemislam.viewer"
"""Set in the scope of requests by those who may look only."""

log = logging.getLogger(__name__)

_TOO_LARGE = f"Nothing that is larger than {MOST_BYTES >> 10} kB is taken."

OPEN_PATHS = ("/healthz",)
"""Answered without a token: they say nothing but that the server is there."""


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
        token: lets in; None on a loopback address. viewer_token: lets look only; None: there is no such link.
        secure: whether it speaks TLS.
    """

    port: int
    token: str | None = None
    viewer_token: str | None = None
    secure: bool = False

    @classmethod
    def on(cls, host: str, port: int, *, secure: bool = False) -> "Access":
        """For a server bound to this address; makes new tokens where they are needed."""
        if is_loopback(host):
            return cls(port, secure=secure)
        return cls(port, secrets.token_urlsafe(24), secrets.token_urlsafe(24), secure)

    @property
    def cookie(self) -> str:
        """Cookies know no ports, so the name does."""
        return f"hemislam-{self.port}"

    def known(self, token: str) -> bool:
        """Whether it is one of ours."""
        return _same(token, self.token) or _same(token, self.viewer_token)


class Guard:
    """Middleware that applies the rules and adds the headers that bind the browser to them."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app = app
        self._access = access
        self._held = 0  # bytes of bodies

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        if refusal := self._refusal(scope, Headers(scope=scope)):
            client = scope.get("client") or ("?", 0)
            path = quote(scope["path"])  # it must not look like another line of the log
            log.warning("Refused %s from %s: %s", path, client[0], refusal[1], extra={"status": refusal[0]})
            await _refuse(scope, receive, send, *refusal)
        elif token := self._linked(scope):
            await self._keep(scope, token)(scope, receive, _with_headers(send))
        elif scope["type"] == "http":
            await self._take(scope, receive, _with_headers(send))
        else:
            await self._app(scope, receive, send)

    async def _take(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, but no body that is too large, whether or not its length was told, nor too many."""
        received = 0

        async def receiver() -> Message:
            nonlocal received
            message = await receive()
            length = len(message.get("body", b""))
            received += length
            self._held += length
            if received > MOST_BYTES:
                raise HTTPException(413, _TOO_LARGE)
            if self._held > MOST_BYTES_AT_ONCE:
                raise HTTPException(503, "Too much is being sent at once; send it again in a moment.")
            return message

        try:
            await self._app(scope, receiver, send)
        finally:
            self._held -= received

    def _refusal(self, scope: Scope, headers: Headers) -> tuple[int, str] | None:
        """Status and reason, if the request must not go on. Notes in its scope if it may look only."""
        host = headers.get("host", "")
        if any(_origin(origin) != host.lower() for origin in headers.getlist("origin")):
            return 403, "This page belongs to another site and may not talk to hemislam."
        if refusal := self._without_token(scope, headers, host):
            return refusal
        length = headers.get("content-length", "0")
        if not length.isdecimal():
            return 400, "The length of the request is not a number."
        if int(length) > MOST_BYTES:
            return 413, _TOO_LARGE
        return None

    def _without_token(self, scope: Scope, headers: Headers, host: str) -> tuple[int, str] | None:
        if self._access.token is None:
            return None if is_loopback(_name(host)) else (403, "Open hemislam as http://127.0.0.1 or http://localhost.")
        given = self._given(scope, headers)
        if scope["path"] in OPEN_PATHS or any(_same(one, self._access.token) for one in given):
            return None
        if not any(_same(one, self._access.viewer_token) for one in given):
            return 401, "Open hemislam by the link that it printed when it started; the token in it is needed once."
        scope[VIEWER] = True
        if scope["type"] == "http" and scope["method"] not in ("GET", "HEAD"):
            return 403, "This link is for looking only; the other one that hemislam printed lets you act."
        return None

    def _given(self, scope: Scope, headers: Headers) -> list[str]:
        """All tokens that came with the request."""
        given = [value for name, value in _query(scope) if name == "token"] if scope["type"] == "http" else []
        given.append(headers.get("authorization", "").removeprefix("Bearer "))
        try:
            cookies = SimpleCookie(headers.get("cookie", ""))
        except CookieError:
            return given
        if self._access.cookie in cookies:
            given.append(cookies[self._access.cookie].value)
        return given

    def _linked(self, scope: Scope) -> str | None:
        """The token in the address, if one of ours is: it moves into a cookie and out of sight."""
        if self._access.token is None or scope["type"] != "http" or scope["method"] != "GET":
            return None
        return next((value for name, value in _query(scope) if name == "token" and self._access.known(value)), None)

    def _keep(self, scope: Scope, token: str) -> RedirectResponse:
        rest = urlencode([(name, value) for name, value in _query(scope) if name != "token"])
        # Only a path of ours: "//elsewhere" would leave for another host.
        response = RedirectResponse("/" + scope["path"].lstrip("/\\") + (f"?{rest}" if rest else ""), status_code=303)
        response.set_cookie(self._access.cookie, token, httponly=True, samesite="lax", secure=self._access.secure)
        return response


def _query(scope: Scope) -> list[tuple[str, str]]:
    return parse_qsl(scope["query_string"].decode("latin-1"), keep_blank_values=True)


def _origin(origin: str) -> str | None:
    """Host and port of an Origin header; None: it names none."""
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return None


def _name(host: str) -> str:
    """The name in a Host header, without the port."""
    return host[: host.rindex("]") + 1] if "]" in host else host.partition(":")[0]


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
            headers["Content-Security-Policy"] = CONTENT_SECURITY_POLICY
            headers["X-Content-Type-Options"] = "nosniff"
            headers["Referrer-Policy"] = "no-referrer"
            headers.setdefault("Cache-Control", "no-store")
        await send(message)

    return sender
