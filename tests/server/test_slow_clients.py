"""Clients that never end what they begin: they are let go, others are served meanwhile, and nothing piles up."""

import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import httpx
import pytest
from server_site import PATIENCE_S, Site
from test_safety import CAMERA, packed, until
from websockets.exceptions import InvalidStatus

from app.server import access, api, patience, web
from app.server.access import MOST_BYTES
from app.server.patience import PatientProtocol


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(patience, "REQUEST_S", 1.0)
    monkeypatch.setattr(patience, "READ_S", 1.0)


@contextlib.contextmanager
def talking(site: Site, *beginnings: bytes) -> Iterator[list[socket.socket]]:
    """One connection for each of the beginnings."""
    with contextlib.ExitStack() as stack:
        peers = []
        for beginning in beginnings:
            peers.append(stack.enter_context(socket.create_connection(("127.0.0.1", site.port), PATIENCE_S)))
            peers[-1].sendall(beginning)
        yield peers


def head(site: Site, length: int) -> bytes:
    host = f"Host: 127.0.0.1:{site.port}\r\nContent-Type: application/json"
    return f"POST /api/notes HTTP/1.1\r\n{host}\r\nContent-Length: {length}\r\n\r\n".encode()


def ended(peer: socket.socket) -> bool:
    """Whether the server closed it without an answer."""
    try:
        return peer.recv(100) == b""
    except ConnectionResetError:
        return True


def test_whoever_says_nothing_or_half_of_it_is_let_go_and_others_are_served(site: Site) -> None:
    with talking(site, b"", b"GET / HT", b"GET / HTTP/1.1\r\nHost: ", head(site, 1000) + b'{"text":') as peers:
        assert httpx.get(site.url("/healthz")).status_code == 200
        assert all(map(ended, peers))
    until(lambda: not PatientProtocol._waiting)


def test_a_request_that_trickles_in_is_let_go_however_alive_it_looks(site: Site) -> None:
    for beginning in (b"GET / HTTP/1.1\r\nX: ", head(site, 1000)):
        with talking(site, beginning) as (peer,):
            deadline = time.monotonic() + PATIENCE_S
            with pytest.raises(OSError):  # a reset or a broken pipe
                while True:
                    assert time.monotonic() < deadline
                    peer.sendall(b" ")
                    time.sleep(0.05)


def test_a_request_that_takes_its_time_is_answered_and_the_next_has_as_long(site: Site) -> None:
    body = b'{"text": "slow"}'
    with talking(site, b"") as (peer,):
        for _ in range(3):
            for part in (head(site, len(body)), body[:8], body[8:]):
                time.sleep(0.2)
                peer.sendall(part)
            answer = b""
            while not answer.endswith(b"\r\n\r\nnull"):
                part = peer.recv(1000)
                assert part
                answer += part
            assert b" 202 " in answer.splitlines()[0]


def test_one_who_reads_nothing_is_let_go(site: Site) -> None:
    ask = f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{site.port}\r\n\r\n".encode()
    with socket.socket() as peer:
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        peer.connect(("127.0.0.1", site.port))
        peer.sendall(10 * ask)  # more than fits between the two
        time.sleep(2.5)
        peer.settimeout(PATIENCE_S)
        taken = 0
        with contextlib.suppress(ConnectionResetError):
            while part := peer.recv(1 << 20):
                taken += len(part)
    assert taken < 10 * len(httpx.get(site.url()).content)


def test_no_part_of_an_answer_waits_until_the_one_before_is_acknowledged(site: Site) -> None:
    """Else the second half of each comes 40 ms later, on a connection that stays open."""
    with talking(site, b"GET / HT"):
        until(lambda: PatientProtocol._waiting)
        taken = next(iter(PatientProtocol._waiting)).transport.get_extra_info("socket")
        assert taken.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


def test_a_page_stays_however_long_it_says_nothing(site: Site) -> None:
    with site.socket() as page:
        time.sleep(1.6)
        assert page.ping().wait(PATIENCE_S)
        assert not PatientProtocol._waiting


def test_of_many_who_wait_the_oldest_makes_room(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(patience, "REQUEST_S", 60.0)
    monkeypatch.setattr(patience, "MOST_WAITING", 20)
    with talking(site, *([b"GET"] * 60)) as peers:
        assert all(map(ended, peers[:30]))
        assert httpx.get(site.url("/healthz")).status_code == 200
        assert len(PatientProtocol._waiting) <= 20
    until(lambda: not PatientProtocol._waiting)


def test_a_head_without_end_is_refused(site: Site) -> None:
    with talking(site, b"GET / HTTP/1.1\r\n") as (peer,), contextlib.suppress(OSError):
        for _ in range(1000):
            peer.sendall(b"X: " + b"y" * 10_000)
        pytest.fail("ten megabytes of a head were taken")
    assert httpx.get(site.url("/healthz")).status_code == 200


def test_bodies_that_come_at_once_are_bounded_together_and_given_back(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(patience, "REQUEST_S", 60.0)
    monkeypatch.setattr(access, "MOST_BYTES_AT_ONCE", 2 * MOST_BYTES)
    part = b" " * (MOST_BYTES - 1000)
    with talking(site, *([head(site, MOST_BYTES) + part] * 4)) as peers:
        refused = []

        def some_are_refused() -> bool:
            for peer in peers:
                peer.setblocking(False)
                with contextlib.suppress(BlockingIOError):
                    refused.append(peer.recv(1000))
            return len(refused) >= 2

        until(some_are_refused)
        assert all(b" 503 " in answer.splitlines()[0] for answer in refused)
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
    monkeypatch.setattr(api, "_save", lambda *_, **__: written.wait(PATIENCE_S))
    ask = partial(httpx.get, site.url("/api/export/map.ply"), timeout=PATIENCE_S)
    with ThreadPoolExecutor(60) as many:
        answers = [many.submit(ask) for _ in range(60)]
        until(lambda: sum(answer.done() for answer in answers) >= 60 - api.MOST_EXPORTS)
        assert httpx.get(site.url("/api/state")).status_code == 200
        written.set()
        assert sum(answer.result().status_code == 503 for answer in answers) == 60 - api.MOST_EXPORTS
    assert ask().status_code == 404, "others can be exported again; there is none here"
