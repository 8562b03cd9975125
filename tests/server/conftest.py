"""The engine's process is newly spawned and must find `server_fakes`, so this folder is added to the path."""

import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import httpx
import pytest

sys.path.insert(0, str(Path(__file__).parent))

import server_fakes as fakes
from server_site import Site, engine_recording, serving

from app.server.setup import Setup
from app.server.viser_adapter import Viser, start_viser
from app.server.worker import EngineProcess


@pytest.fixture(scope="session", autouse=True)
def _certificates_read_once() -> Iterator[None]:
    """httpx would read the certificates of the world's authorities for each request, which takes 27 ms."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(httpx._transports.default, "create_ssl_context", cache(httpx.create_ssl_context))
        yield


@pytest.fixture(scope="module")
def engine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EngineProcess]:
    recording = tmp_path_factory.mktemp("recordings") / "walk-60.mcap"
    recording.write_bytes(b"x")
    (recording.parent / "walk-30.mcap").write_bytes(b"x")
    process = EngineProcess(Setup(recording=recording), main=fakes.fake_main)
    yield process
    process.close()


@pytest.fixture(scope="module")
def target() -> Iterator[Viser]:
    running = start_viser()
    yield running
    running.stop()


@pytest.fixture(scope="module")
def site(engine: EngineProcess, target: Viser) -> Iterator[Site]:
    recording = engine_recording(engine)
    with serving(engine, target, recording.parent, None) as running:
        yield running


@pytest.fixture(scope="module")
def locked_site(engine: EngineProcess, target: Viser) -> Iterator[Site]:
    with serving(engine, target, engine_recording(engine).parent, "the-token") as running:
        yield running


@pytest.fixture(scope="module")
def public_site(engine: EngineProcess, target: Viser) -> Iterator[Site]:
    """A server as on a public address, with both tokens."""
    with serving(engine, target, engine_recording(engine).parent, "for-owners", "for-viewers") as running:
        yield running
