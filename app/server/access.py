"""Who may talk to the server: checked for every request and every WebSocket, before anything else.

- A page of another site must not reach us through the user's browser: its Origin is refused.
- On a loopback address there is no token, so the Host must be a loopback name (DNS rebinding).
- On any other address a token is needed: in the link once, then in a cookie, or as a bearer token.
"""

import hmac
import ipaddress
import secrets
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qsl, urlencode, urlsplit

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
    """The rules for one server. `token` is None on a loopback address."""

    port: int
    token: str | None = None

    @classmethod
    def on(cls, host: str, port: int) -> "Access":
        """For a server bound to this address; makes a new token where one is needed."""
        return cls(port, None if is_loopback(host) else secrets.token_urlsafe(24))

    @property
    def cookie(self) -> str:
        """Cookies know no ports, so the name does."""
        return f"hemislam-{self.port}"


class Guard:
    """Middleware that applies the rules and adds the headers that bind the browser to them."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app = app
        self._access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        if refusal := self._refusal(scope, headers):
            await _refuse(scope, receive, send, *refusal)
        elif scope["type"] == "http" and self._linked(scope):
            await self._keep_token(scope)(scope, receive, _with_headers(send))
        else:
            await self._app(scope, receive, _with_headers(send))

    def _refusal(self, scope: Scope, headers: Headers) -> tuple[int, str] | None:
        """Status and reason, if the request must not go on."""
        host = headers.get("host", "")
        origin = headers.get("origin")
        if origin is not None and urlsplit(origin).netloc.lower() != host.lower():
            return 403, "This page belongs to another site and may not talk to hemislam."
        token = self._access.token
        if token is None:
            return None if is_loopback(_name(host)) else (403, "Open hemislam as http://127.0.0.1 or http://localhost.")
        if scope["path"] in OPEN_PATHS or any(_same(given, token) for given in self._given(scope, headers)):
            return None
        return 401, "Open hemislam by the link that it printed when it started; the token in it is needed once."

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

    def _linked(self, scope: Scope) -> bool:
        """Whether the token is in the address: then it moves into a cookie and out of sight."""
        token = self._access.token
        return token is not None and scope["method"] == "GET" and any(name == "token" for name, _ in _query(scope))

    def _keep_token(self, scope: Scope) -> RedirectResponse:
        rest = urlencode([(name, value) for name, value in _query(scope) if name != "token"])
        # Only a path of ours: "//elsewhere" would leave for another host.
        response = RedirectResponse("/" + scope["path"].lstrip("/\\") + (f"?{rest}" if rest else ""), status_code=303)
        response.set_cookie(self._access.cookie, self._access.token or "", httponly=True, samesite="lax")
        return response


def _query(scope: Scope) -> list[tuple[str, str]]:
    return parse_qsl(scope["query_string"].decode("latin-1"), keep_blank_values=True)


def _name(host: str) -> str:
    """The name in a Host header, without the port."""
    return host[: host.rindex("]") + 1] if "]" in host else host.partition(":")[0]


def _same(given: str, token: str) -> bool:
    return hmac.compare_digest(given.encode(), token.encode())


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
