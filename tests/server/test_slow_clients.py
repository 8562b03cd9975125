"""Clients that never finish: they are disconnected, others are served meanwhile, and no data accumulates."""

import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import pytest
from server_site import CAMERA, TIMEOUT_S, Site, packed, serving, until
from websockets.exceptions import InvalidStatus

from app.server import access, address, api, web
from app.server.access import MOST_BYTES
from app.server.viser_adapter import Viser
from app.server.worker import EngineProcess


@pytest.fixture(autouse=True)
def short_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(access, "BODY_S", 1.0)


@contextlib.contextmanager
def talking(site: Site, *beginnings: bytes) -> Iterator[list[socket.socket]]:
    """One connection for each of the beginnings."""
    with contextlib.ExitStack() as stack:
        peers = []
        for beginning in beginnings:
            peers.append(stack.enter_context(socket.create_connection(("127.0.0.1", site.port), TIMEOUT_S)))
            peers[-1].sendall(beginning)
        yield peers


def head(site: Site, length: int) -> bytes:
    host = f"Host: 127.0.0.1:{site.port}\r\nContent-Type: application/json"
    return f"POST /api/notes HTTP/1.1\r\n{host}\r\nContent-Length: {length}\r\n\r\n".encode()


def answer(peer: socket.socket) -> bytes:
    """All that the server sends until it closes the connection."""
    received = b""
    while part := peer.recv(1000):
        received += part
    return received


def test_a_body_that_does_not_arrive_in_time_is_refused_and_its_connection_closed(site: Site) -> None:
    with talking(site, *([head(site, 1000) + b'{"text":'] * 3)) as peers:
        assert httpx.get(site.url("/healthz")).status_code == 200
        for peer in peers:
            assert b" 408 " in answer(peer).splitlines()[0]


def test_a_body_that_trickles_in_is_refused_too(site: Site) -> None:
    with talking(site, head(site, 1000)) as (peer,):
        deadline = time.monotonic() + TIMEOUT_S
        with pytest.raises(OSError):  # a reset or a broken pipe
            while True:
                assert time.monotonic() < deadline
                peer.sendall(b" ")
                time.sleep(0.05)


def test_a_slow_request_is_answered_and_the_next_has_as_long(site: Site) -> None:
    body = b'{"text": "slow"}'
    with talking(site, b"") as (peer,):
        for _ in range(3):
            for part in (head(site, len(body)), body[:8], body[8:]):
                time.sleep(0.2)
                peer.sendall(part)
            received = b""
            while not received.endswith(b"\r\n\r\nnull"):
                part = peer.recv(1000)
                assert part
                received += part
            assert b" 202 " in received.splitlines()[0]


def test_an_idle_connection_is_closed_after_its_request(site: Site) -> None:
    with talking(site, f"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1:{site.port}\r\n\r\n".encode()) as (peer,):
        begin = time.monotonic()
        assert b" 200 " in answer(peer).splitlines()[0]
        assert 3.0 < time.monotonic() - begin < TIMEOUT_S


def served(port: int, peer: socket.socket) -> bool:
    """Whether the server's end of a connection is open, as Linux tells it of all."""
    ends = f":{port:04X}", f":{peer.getsockname()[1]:04X}"
    lines = (line.split() for line in Path("/proc/net/tcp").read_text().splitlines())
    return any(line[1].endswith(ends[0]) and line[2].endswith(ends[1]) for line in lines)


@pytest.mark.skipif(not hasattr(socket, "TCP_USER_TIMEOUT"), reason="the system has no limit for unread data")
def test_a_client_that_reads_nothing_is_disconnected(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(address, "UNREAD_S", 1)
    with serving(site.engine, site.viser, site.folder, None) as strict, socket.socket() as peer:
        ask = f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{strict.port}\r\n\r\n".encode()
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        peer.connect(("127.0.0.1", strict.port))
        peer.sendall(10 * ask)  # the answers exceed all buffers on the way
        until(lambda: not served(strict.port, peer))
        peer.settimeout(TIMEOUT_S)
        taken = 0
        with contextlib.suppress(ConnectionResetError):
            while part := peer.recv(1 << 20):
                taken += len(part)
        assert taken < 10 * len(httpx.get(strict.url()).content)


def test_small_answers_do_not_wait_for_acknowledgements(site: Site) -> None:
    """With Nagle's algorithm, the second half of each answer comes 40 ms later on a connection that stays open."""
    ask = f"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1:{site.port}\r\n\r\n".encode()
    times = []
    with talking(site, b"") as (peer,):
        for _ in range(20):
            begin = time.monotonic()
            peer.sendall(ask)
            received = b""
            while not received.endswith(b"}"):
                received += peer.recv(1000)
            times.append(time.monotonic() - begin)
    assert sorted(times)[len(times) // 4] < 0.03


def test_a_page_may_be_silent(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(access, "BODY_S", 0.2)
    with site.socket() as page:
        time.sleep(0.6)
        assert page.ping().wait(TIMEOUT_S)


def test_beyond_the_limit_of_connections_requests_are_turned_away(
    engine: EngineProcess, target: Viser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(web, "MOST_CONNECTIONS", 20)
    with serving(engine, target, tmp_path, None) as site:
        with talking(site, *([b"GET"] * 30)):
            until(lambda: httpx.get(site.url("/healthz")).status_code == 503)
            assert httpx.get(site.url("/healthz")).status_code == 503, "as long as the connections are there"
        until(lambda: httpx.get(site.url("/healthz")).status_code == 200)


def test_a_head_without_end_is_refused(site: Site) -> None:
    with talking(site, b"GET / HTTP/1.1\r\n") as (peer,), contextlib.suppress(OSError):
        for _ in range(1000):
            peer.sendall(b"X: " + b"y" * 10_000)
        pytest.fail("ten megabytes of a head were taken")
    assert httpx.get(site.url("/healthz")).status_code == 200


def test_bodies_that_come_at_once_are_bounded_together_and_given_back(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(access, "BODY_S", 60.0)
    monkeypatch.setattr(access, "MOST_BYTES_AT_ONCE", 2 * MOST_BYTES)
    part = b" " * (MOST_BYTES - 1000)
    with talking(site, *([head(site, MOST_BYTES) + part] * 4)) as peers:
        beginnings: dict[socket.socket, bytes] = {}

        def some_are_refused() -> bool:
            for peer in peers:
                peer.setblocking(False)
                if peer not in beginnings:  # an answer may come in several parts
                    with contextlib.suppress(BlockingIOError):
                        beginnings[peer] = peer.recv(1000)
            return len(beginnings) >= 2

        until(some_are_refused)
        assert all(b" 503 " in one.splitlines()[0] for one in beginnings.values())
    ask: dict[str, Any] = {"content": b" " * (MOST_BYTES - 20) + b'{"text": "large"}'}
    ask["headers"] = {"Content-Type": "application/json"}
    until(lambda: httpx.post(site.url("/api/notes"), **ask).status_code == 202)


def test_pages_that_never_say_anything_are_counted(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web, "MOST_PAGES", 3)
    with contextlib.ExitStack() as stack:
        pages = [stack.enter_context(site.socket()) for _ in range(3)]
        with pytest.raises(InvalidStatus):
            site.socket()
        assert httpx.get(site.url("/healthz")).status_code == 200
        pages[0].close()
        until(lambda: _opens(site))


def _opens(site: Site) -> bool:
    try:
        site.socket().close()
    except InvalidStatus:
        return False
    return True


def test_half_an_upload_goes_with_its_page(site: Site) -> None:
    states = site.viser.server.gui._current_file_upload_states
    button = site.viser.server.gui.add_upload_button("half an upload")
    begin = {
        "type": "FileTransferStartUpload", "source_component_uuid": button._impl.uuid, "transfer_uuid": "half",
        "filename": "a.yaml", "mime_type": "text/yaml", "part_count": 2, "size_bytes": 100,
    }  # fmt: skip
    page = site.socket()
    page.send(packed(**CAMERA))
    page.send(packed(**begin))
    until(lambda: "half" in states)
    page.socket.shutdown(socket.SHUT_RDWR)  # as a browser that crashes
    until(lambda: "half" not in states)
    assert not states, "nor is anything else of it kept"
    button.remove()


def test_slow_exports_leave_threads_for_others(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    written = threading.Event()
    monkeypatch.setattr(api, "_save", lambda *_, **__: written.wait(TIMEOUT_S))
    ask = partial(httpx.get, site.url("/api/export/map.ply"), timeout=TIMEOUT_S)
    with ThreadPoolExecutor(60) as many:
        answers = [many.submit(ask) for _ in range(60)]
        until(lambda: sum(answer.done() for answer in answers) >= 60 - api.MOST_EXPORTS)
        assert httpx.get(site.url("/api/state")).status_code == 200
        written.set()
        assert sum(answer.result().status_code == 503 for answer in answers) == 60 - api.MOST_EXPORTS
    assert ask().status_code == 404, "others can be exported again; there is none here"
