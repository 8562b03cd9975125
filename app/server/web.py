"""The one public port: viser's page, the bridge to it, and the REST interface."""

import asyncio
import contextlib
import errno
import json
import logging
import math
import os
import signal
import socket
import ssl
import sys
import threading
import webbrowser
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Protocol

import uvicorn
import viser
from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, JSONResponse
from starlette.websockets import WebSocket
from tqdm import tqdm

from app import __version__
from app.server.access import MOST_BYTES, VIEWER, Access, Guard
from app.server.api import make_router
from app.server.folders import Folders
from app.server.fork import Engine, Workspace
from app.server.logs import log_notices
from app.server.patience import PatientProtocol
from app.server.setup import Setup
from app.server.viser_page import BUFFER_BYTES, Viser, bridge, page_html, start_viser, viewer_html
from app.server.worker import EngineProcess
from app.slam.errors import HemislamError

log = logging.getLogger(__name__)

MOST_PAGES = 32
"""Open at once, of those who may look only, and as many of others: each takes a megabyte or two."""


class Page(Protocol):
    """What draws the session into viser; `app.ui.workbench.Workbench`."""

    def start(self) -> None: ...
    def close(self) -> None: ...


BuildPage = Callable[[viser.ViserServer, Workspace, Folders], Page]


class _Refused(JSONResponse):
    """What can not be used is named as it came, be it half of a character: as ASCII, all can be written."""

    def render(self, content: object) -> bytes:
        return json.dumps(content).encode("ascii")


def make_app(engine: Engine, folders: Folders, target: Viser, access: Access) -> FastAPI:
    """Everything that is reachable from outside."""
    app = FastAPI(
        title="hemislam",
        version=__version__,
        openapi_url="/api/openapi.json",
        docs_url=None,  # their pages load scripts from elsewhere
        redoc_url=None,
    )
    app.add_middleware(Guard, access=access)
    page = page_html()
    viewers_page = viewer_html(page)
    pages: Counter[bool] = Counter()  # that are open, of those who may look only and of others

    @app.get("/", response_class=HTMLResponse, include_in_schema=False)
    def index(request: Request) -> str:
        return viewers_page if VIEWER in request.scope else page

    @app.websocket("/")
    async def messages(browser: WebSocket) -> None:
        viewer = VIEWER in browser.scope
        if pages[viewer] >= MOST_PAGES:
            await browser.close(1013, "Too many pages are open.")
            return
        pages[viewer] += 1
        try:
            with contextlib.suppress(asyncio.CancelledError):  # the server ends, and a stalled browser does not
                await bridge(browser, target, viewer=viewer)
        finally:
            pages[viewer] -= 1

    @app.get("/healthz")
    def health(response: Response) -> dict[str, str]:
        """Whether all is there: 200, or 503 if the engine or the live source has ended for good."""
        snapshot = engine.snapshot
        source_ended = snapshot.live is not None and snapshot.transport.finished
        if snapshot.engine_alive and not source_ended:
            return {"status": "ok"}
        response.status_code = 503
        return {"status": "live source down" if snapshot.engine_alive else "engine down"}

    @app.exception_handler(HemislamError)
    def refused(request: Request, error: HemislamError) -> JSONResponse:
        return _Refused({"detail": str(error)}, status_code=422)

    @app.exception_handler(RequestValidationError)
    def not_understood(request: Request, error: RequestValidationError) -> JSONResponse:
        told = [{name: one[name] for name in ("type", "loc", "msg")} for one in error.errors()]
        return _Refused({"detail": told}, status_code=422)

    app.include_router(make_router(engine, folders))
    return app


def run_server(
    setup: Setup,
    *,
    folders: Folders,
    build_page: BuildPage,
    host: str = "127.0.0.1",
    port: int = 8080,
    open_browser: bool = True,
    start_engine: Callable[[Setup], EngineProcess] = EngineProcess,
    tls: "Tls | None" = None,
) -> None:
    """Serve the workbench until Ctrl-C or SIGTERM; then end the engine's process and everything else.

    Args:
        setup: what the engine starts with. folders: what the page may open.
        build_page: makes the page.
        host, port: to bind to; beyond loopback a token is made and is part of the printed link. Port 0: a free one.
        open_browser: if there is a display to open one on.
        start_engine: another one only in tests.
        tls: certificate and key to speak https by.

    Raises:
        HemislamError: the address can not be bound to, or the certificate not be used.
    """
    if tls is not None:
        tls.check()
    listener = listen(host, port)
    port = listener.getsockname()[1]
    access = Access.on(host, port, secure=tls is not None)
    with contextlib.ExitStack() as cleanup:
        cleanup.callback(listener.close)
        engine = start_engine(setup)
        workspace = Workspace(engine, setup, start_engine)
        cleanup.callback(workspace.close)
        target = start_viser()
        cleanup.callback(target.stop)
        page = build_page(target.server, workspace, folders)
        page.start()
        cleanup.callback(page.close)
        server = make_server(make_app(workspace, folders, target, access), tls)
        address, *others = links(host, access)
        print(f"hemislam is at {address} (Ctrl-C ends it)", flush=True)
        for other in others:
            print(f"from other computers: {other}", flush=True)
        if access.viewer_token:
            print(f"to look only: {links(host, access, access.viewer_token)[-1]}", flush=True)
        log.info("Serving on %s:%d", host, port)
        threading.Thread(target=log_notices, args=(workspace,), name="log", daemon=True).start()
        threading.Thread(target=show_compilation, args=(engine,), name="progress", daemon=True).start()
        if open_browser and _has_display():
            webbrowser.open(address)  # the listener holds the request until the server is up
        server.run(sockets=[listener])
        log.info("Ending")


def listen(host: str, port: int) -> socket.socket:
    """A listening socket.

    Raises:
        HemislamError: the port is busy, or the address is not this machine's.
    """
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
    except OSError:
        raise HemislamError(f"{host} is no address of this machine; choose another one by --host.") from None
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)  # named, or asyncio would leave Nagle on
    if os.name == "posix":  # elsewhere it would let two servers share the port
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
    try:
        listener.bind(address)
        listener.listen(128)
    except OSError as error:
        listener.close()
        if error.errno == errno.EADDRINUSE:
            raise HemislamError(f"Port {port} is in use by another program; choose another one by --port.") from None
        raise HemislamError(
            f"The address {host}:{port} can not be used ({error.strerror}); choose another one by --host and --port."
        ) from None
    return listener


def links(host: str, access: Access, token: str | None = None) -> list[str]:
    """The addresses to open, with the token if there is one: first for this computer, then for others.

    token: another one than that which lets in.
    """
    names = [host]
    if host in ("0.0.0.0", "::", ""):
        names = ["localhost", _own_address()]
    token = token or access.token
    query = f"?token={token}" if token else ""
    scheme = "https" if access.secure else "http"
    return [f"{scheme}://{f'[{name}]' if ':' in name else name}:{access.port}/{query}" for name in names]


def _own_address() -> str:
    """This computer's address on the network that leads outside; its name if there is none."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # sends nothing: it only chooses the way
            return str(probe.getsockname()[0])
        except OSError:
            return socket.gethostname()


def show_compilation(engine: EngineProcess) -> None:
    """A progress bar in the terminal while the engine compiles; it takes a minute on a first start."""
    with tqdm(total=1.0, disable=None, leave=False, bar_format="{desc}: {percentage:3.0f}% |{bar}|") as bar:
        snapshot = engine.snapshot
        while snapshot.engine_alive and (snapshot.revision == 0 or snapshot.progress is not None):
            if snapshot.progress is not None and math.isfinite(snapshot.progress.fraction):
                bar.set_description_str(snapshot.progress.title)
                bar.update(snapshot.progress.fraction - bar.n)
            snapshot = engine.wait(snapshot.revision, timeout=0.5)


def _has_display() -> bool:
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


@dataclass(frozen=True, slots=True)
class Tls:
    """Files in PEM: the certificate with what it is signed by, and its key, which may be in the same file."""

    certificate: Path
    key: Path | None = None

    def check(self) -> None:
        """Raises HemislamError: they can not be used."""
        try:
            ssl.create_default_context(ssl.Purpose.CLIENT_AUTH).load_cert_chain(self.certificate, self.key)
        except OSError as error:  # an SSLError is one
            raise HemislamError(
                f"The certificate {self.certificate}{f' with the key {self.key}' if self.key else ''} can not be used"
                f" ({error.strerror or error}); give both as PEM by --certificate and --key."
            ) from None


def make_server(app: FastAPI, tls: Tls | None = None) -> uvicorn.Server:
    """What runs the app. Nothing is compressed: it would cost more than it saves on this machine."""
    config = uvicorn.Config(
        app,
        log_level="warning",
        log_config=None,
        lifespan="off",
        http=PatientProtocol,
        ws="websockets-sansio",
        ws_per_message_deflate=False,
        ws_max_size=2 * MOST_BYTES,
        ssl_certfile=tls.certificate if tls else None,
        ssl_keyfile=tls.key if tls else None,
        timeout_graceful_shutdown=1,
        server_header=False,
    )
    return _Server(config)


class _Server(uvicorn.Server):
    """Ends on SIGINT and SIGTERM, and leaves it there: uvicorn would raise the signal again at the end."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        if threading.current_thread() is not threading.main_thread():  # only there signals can be heard
            yield
            return

        def end(number: int, frame: FrameType | None) -> None:
            self.force_exit = self.should_exit
            self.should_exit = True

        before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
