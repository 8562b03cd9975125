"""The only public port: viser's page, the bridge to viser, and the REST interface."""

import asyncio
import contextlib
import json
import logging
import math
import signal
import ssl
import threading
import webbrowser
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

import uvicorn
import viser
from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, JSONResponse
from starlette.websockets import WebSocket
from tqdm import tqdm

from app import __version__
from app.server.access import MOST_OF_PICTURE, VIEWER, Access, Guard
from app.server.address import has_display, links, listen
from app.server.api import make_router
from app.server.bridge import bridge
from app.server.folders import Folders
from app.server.fork import Workspace
from app.server.setup import Setup
from app.server.viser_adapter import BADGE, Viser, page_html, start_viser
from app.server.worker import EngineProcess, RunningEngine
from app.slam.errors import HemislamError

log = logging.getLogger(__name__)

MOST_PAGES: Final = 32
"""Most open pages with the view-only token; the same limit applies to other pages. Each takes a megabyte or two."""
MOST_CONNECTIONS: Final = 500
"""Most concurrent requests; further requests are answered with status 503."""


class ServedPage(Protocol):
    """Draws the session into viser; implemented by `app.ui.workbench.Workbench`."""

    @property
    def parts(self) -> str: ...
    def start(self) -> None: ...
    def close(self) -> None: ...


BuildPage = Callable[[viser.ViserServer, Workspace, Folders], ServedPage]


class _AsciiJson(JSONResponse):
    """JSON in ASCII: an error message may quote a lone surrogate, which UTF-8 cannot encode."""

    def render(self, content: object) -> bytes:
        return json.dumps(content).encode("ascii")


def make_app(engine: RunningEngine, folders: Folders, target: Viser, access: Access, parts: str = "") -> FastAPI:
    """The application with everything that can be reached from outside. parts: HTML that belongs into viser's page."""
    app = FastAPI(
        title="hemislam",
        version=__version__,
        openapi_url="/api/openapi.json",
        docs_url=None,  # FastAPI's documentation pages load scripts from other sites
        redoc_url=None,
    )
    app.add_middleware(Guard, access=access)
    page, viewers_page = page_html(parts), page_html(parts, BADGE)
    pages: Counter[bool] = Counter()  # open pages, by whether they are view-only

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
            with contextlib.suppress(asyncio.CancelledError):  # the server ends while a stalled browser is still open
                await bridge(browser, target, viewer=viewer)
        finally:
            pages[viewer] -= 1

    @app.get("/healthz")
    def health(response: Response) -> dict[str, str]:
        """Status 200, or 503 if the engine or the live source has ended for good."""
        snapshot = engine.snapshot
        source_ended = snapshot.live is not None and snapshot.transport.finished
        if snapshot.engine_alive and not source_ended:
            return {"status": "ok"}
        response.status_code = 503
        return {"status": "live source down" if snapshot.engine_alive else "engine down"}

    @app.exception_handler(HemislamError)
    def refused(request: Request, error: HemislamError) -> JSONResponse:
        return _AsciiJson({"detail": str(error)}, status_code=422)

    @app.exception_handler(RequestValidationError)
    def invalid(request: Request, error: RequestValidationError) -> JSONResponse:
        detail = [{name: one[name] for name in ("type", "loc", "msg")} for one in error.errors()]
        return _AsciiJson({"detail": detail}, status_code=422)

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
    """Serve the workbench until Ctrl-C or SIGTERM, then end the engine's process and everything else.

    Args:
        setup: of the engine. folders: those that the page may open. build_page: makes the page.
        host, port: to bind to; port 0: a free one. If others can reach the address, the printed link has a token.
        open_browser: open the page, if there is a display. start_engine: replaced only in tests.
        tls: certificate and key for https.

    Raises:
        HemislamError: the address cannot be bound to.
    """
    listener = listen(host, port)
    access = Access.on(host, listener.getsockname()[1], secure=tls is not None)
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
        server = make_server(make_app(workspace, folders, target, access, page.parts), tls)
        address, *others = links(host, access)
        print(f"hemislam is at {address} (Ctrl-C ends it)", flush=True)
        for other in others:
            print(f"from other computers: {other}", flush=True)
        if access.viewer_token:
            print(f"view only: {links(host, access, access.viewer_token)[-1]}", flush=True)
        log.info("Serving on %s:%d", host, access.port)
        threading.Thread(target=log_notices, args=(workspace,), name="log", daemon=True).start()
        threading.Thread(target=show_compilation, args=(engine,), name="progress", daemon=True).start()
        if open_browser and has_display():
            webbrowser.open(address)  # the listener holds the request until the server is up
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        with contextlib.suppress(KeyboardInterrupt):  # uvicorn shuts down cleanly, then raises the signal again
            server.run(sockets=[listener])
        log.info("Ending")


def log_notices(engine: RunningEngine) -> None:
    """Log the engine's notices, endlessly. Run this in a thread of its own."""
    if not log.isEnabledFor(logging.INFO):
        return  # people read them on the page
    logged: set[int] = set()
    snapshot = engine.snapshot
    while True:
        for notice in snapshot.notices:
            if notice.number not in logged:
                logged.add(notice.number)
                extra = {"notice": notice.number, "frame": snapshot.transport.frame}
                log.log(getattr(logging, notice.level.upper()), notice.text, extra=extra)
        snapshot = engine.wait(snapshot.revision, 1.0)


def show_compilation(engine: EngineProcess) -> None:
    """Show a progress bar in the terminal while the engine compiles, which takes a minute at the first start."""
    with tqdm(total=1.0, disable=None, leave=False, bar_format="{desc}: {percentage:3.0f}% |{bar}|") as bar:
        snapshot = engine.snapshot
        while snapshot.engine_alive and (snapshot.revision == 0 or snapshot.progress is not None):
            if snapshot.progress is not None and math.isfinite(snapshot.progress.fraction):
                bar.set_description_str(snapshot.progress.title)
                bar.update(snapshot.progress.fraction - bar.n)
            snapshot = engine.wait(snapshot.revision, timeout=0.5)


@dataclass(frozen=True, slots=True)
class Tls:
    """PEM files: the certificate with its chain, and its key, which may be in the same file."""

    certificate: Path
    key: Path | None = None

    def check(self) -> None:
        """Load the files. Raises HemislamError: they cannot be used."""
        try:
            ssl.create_default_context(ssl.Purpose.CLIENT_AUTH).load_cert_chain(self.certificate, self.key)
        except OSError as error:  # SSLError is a subclass
            raise HemislamError(
                f"The certificate {self.certificate}{f' with the key {self.key}' if self.key else ''} cannot be used"
                f" ({error.strerror or error}); give both as PEM by --certificate and --key."
            ) from None


def make_server(app: FastAPI, tls: Tls | None = None) -> uvicorn.Server:
    """The server that runs the app. It does not compress, which would cost more than it saves on one machine."""
    return uvicorn.Server(
        uvicorn.Config(
            app,
            log_level="warning",
            log_config=None,
            lifespan="off",
            http="h11",
            ws="websockets-sansio",
            ws_per_message_deflate=False,
            ws_max_size=MOST_OF_PICTURE,
            limit_concurrency=MOST_CONNECTIONS,
            ssl_certfile=tls.certificate if tls else None,
            ssl_keyfile=tls.key if tls else None,
            timeout_graceful_shutdown=1,
            server_header=False,
        )
    )
