"""Requests that no well-behaved client makes: each is refused with the right status, and none is a server error."""

import socket
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import pytest
from server_site import Site, serving

from app.sensors.live.status import LiveState
from app.server.viser_adapter import Viser
from tests.ui.fake_engine import FakeEngine

JSON = {"Content-Type": "application/json"}


def answer(site: Site, head: str) -> int:
    """The status of a request that is written by hand."""
    with socket.create_connection(("127.0.0.1", site.port), 10.0) as peer:
        peer.sendall(f"GET {head}\r\n\r\n".encode())
        return int(peer.recv(100).split()[1])


@pytest.mark.parametrize(
    "origins",
    ["Origin: http://[", "Origin: null", "Origin: ", "Origin: http://127.0.0.1:{port}\r\nOrigin: http://elsewhere"],
)
def test_a_malformed_or_second_origin_counts_as_another_site(site: Site, origins: str) -> None:
    host = f"Host: 127.0.0.1:{site.port}"
    assert answer(site, f"/api/state HTTP/1.1\r\n{host}\r\n{origins.format(port=site.port)}") == 403
    assert answer(site, f"/api/state HTTP/1.1\r\n{host}\r\nOrigin: http://127.0.0.1:{site.port}") == 200


def test_a_refused_path_cannot_forge_a_line_of_the_log(site: Site, caplog: Any) -> None:
    assert answer(site, "/%0aAll%20is%20well%1b[2J HTTP/1.1\r\nHost: elsewhere") == 403
    (record,) = [record for record in caplog.records if record.name == "app.server.access"]
    assert record.getMessage().isprintable()
    assert "All%20is%20well" in record.getMessage()


@pytest.mark.parametrize(
    ("method", "path", "body"),
    [
        ("POST", "/api/notes", b'{"text": "\\ud800"}'),
        ("PATCH", "/api/params", b'{"\\ud800": {"alpha": 1}}'),
        ("PATCH", "/api/params", b'{"ground": {"\\ud800": 1}}'),
        ("PATCH", "/api/params", b'{"ground": {"alpha": NaN}}'),
        ("PUT", "/api/breakpoints", b'{"planarity": NaN}'),
        ("PUT", "/api/breakpoints", b'{"residual": -Infinity}'),
        ("PUT", "/api/breakpoints", b'{"\\ud800": 1}'),
        ("POST", "/api/transport", b'{"action": "speed", "factor": NaN}'),
        ("POST", "/api/transport", b'{"action": "\\ud800"}'),
        ("POST", "/api/loops", b'{"action": "weigh", "older": 0, "newer": 1, "weight": NaN}'),
        ("POST", "/api/loops", b'{"action": "accept", "older": 0, "newer": 1000000000000}'),
        ("POST", "/api/recordings", b'{"path": "\\ud800"}'),
        ("POST", "/api/recordings", b'{"path": "\\u0000"}'),
        ("POST", "/api/truth", b'{"path": "\\ud800"}'),
    ],
)
def test_json_with_unusable_values_is_refused(site: Site, method: str, path: str, body: bytes) -> None:
    refused = httpx.request(method, site.url(path), content=body, headers=JSON)
    assert refused.status_code == 422
    assert refused.json()["detail"]
    assert httpx.get(site.url("/api/state")).status_code == 200


def test_health_is_503_when_the_live_source_has_ended(tmp_path: Path) -> None:
    engine = FakeEngine()
    with serving(engine, Viser(None, ""), tmp_path, None) as site:  # type: ignore[arg-type]
        engine.publish(live=LiveState())
        assert httpx.get(site.url("/healthz")).status_code == 200
        engine.publish(transport=replace(engine.snapshot.transport, finished=True))
        health = httpx.get(site.url("/healthz"))
        assert (health.status_code, health.json()) == (503, {"status": "live source down"})
        engine.publish(live=None)
        assert httpx.get(site.url("/healthz")).status_code == 200, "a recording may end"
    engine.close()
