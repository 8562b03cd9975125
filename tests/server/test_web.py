"""The public port over real sockets: the page, tokens and origins, https, and how the server ends.

Tests app/server/address.py.
"""

import asyncio
import json
import os
import re
import signal
import socket
import ssl
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import msgspec
import numpy as np
import pytest
import server_fakes as fakes
import zstandard
from mcap.reader import make_reader
from server_site import OWNER, PROTOCOL, TIMEOUT_S, Site, serving, until
from test_live_run import free_ports
from test_rewind import SAMPLE
from websockets.asyncio.client import connect as asyncio_connect
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

from app.sensors.live.feed import Pace, feed
from app.sensors.live.urls import parse_address
from app.sensors.presets import resolve_params
from app.server.access import Access
from app.server.address import links, listen
from app.server.setup import Setup
from app.server.viser_adapter import Viser
from app.server.web import Tls
from app.server.worker import EngineProcess
from app.slam.errors import HemislamError


# --- page and bridge -----------------------------------------------------------------------------
def test_the_page_is_visers_and_bound_to_this_server(site: Site) -> None:
    answer = httpx.get(site.url())
    assert answer.status_code == 200 and "<title>hemislam</title>" in answer.text
    policy = answer.headers["content-security-policy"]
    assert "connect-src 'self'" in policy and "default-src 'self'" in policy
    assert not re.search(r"https?:", policy)


def messages(raw: str | bytes) -> list[dict[str, Any]]:
    """What viser packs into one WebSocket message."""
    assert isinstance(raw, bytes)
    size = int.from_bytes(raw[8:16], "little")
    unpacked = zstandard.ZstdDecompressor().decompress(raw[16 : 16 + size])
    entries: list[dict[str, Any]] = msgspec.msgpack.decode(unpacked)["messages"]
    return entries


def test_what_viser_shows_reaches_the_page_and_what_the_user_does_goes_back(site: Site) -> None:
    slider = site.viser.server.gui.add_slider("a slider for the test", min=0, max=10, step=1, initial_value=3)
    with site.socket() as browser:
        shown: list[dict[str, Any]] = []
        while not shown:
            received = messages(browser.recv(timeout=TIMEOUT_S))
            shown = [m for m in received if m.get("props", {}).get("label") == "a slider for the test"]
        assert shown[0]["value"] == 3
        update = {"type": "GuiUpdateMessage", "uuid": shown[0]["uuid"], "updates": {"value": 7}}
        browser.send(msgspec.msgpack.encode(update))
        deadline = time.monotonic() + TIMEOUT_S
        while slider.value != 7:
            assert time.monotonic() < deadline
            time.sleep(0.01)
    slider.remove()


def test_a_page_of_another_version_is_refused_and_says_why(site: Site) -> None:
    with connect(f"ws://127.0.0.1:{site.port}/", subprotocols=[Subprotocol("viser-v0.0.1")], proxy=None) as browser:
        with pytest.raises(ConnectionClosed):
            browser.recv(timeout=TIMEOUT_S)
        assert browser.close_code == 1002 and "Version mismatch" in (browser.close_reason or "")


def test_a_browser_that_does_not_read_is_sent_only_the_newest(site: Site) -> None:
    """240 MB are offered to a page that reads nothing. They must not queue up: viser keeps only the newest."""
    points = np.zeros((200_000, 3), dtype=np.float32)
    newest = np.full(100, 100.0, dtype=np.float32).tobytes()
    cloud = site.viser.server.scene.add_point_cloud("/test", points, (0, 0, 0), precision="float32")
    with socket.socket() as browser:
        browser.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 18)
        browser.settimeout(TIMEOUT_S)
        browser.connect(("127.0.0.1", site.port))
        browser.sendall(
            f"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {'A' * 22}==\r\nSec-WebSocket-Version: 13\r\n"
            f"Sec-WebSocket-Protocol: {PROTOCOL}\r\n\r\n".encode()
        )
        for value in range(1, 101):
            cloud.points = points + value
            time.sleep(0.01)
        received, end = 0, b""
        while newest not in end:
            part = browser.recv(1 << 20)
            assert part
            received += len(part)
            end = end[-len(newest) :] + part
    cloud.remove()
    assert received < 60_000_000


def test_a_map_is_sent_in_pieces_that_take_little_memory(site: Site) -> None:
    """12 MB of points in 200 clouds, to a page that opens: each message is copied several times for every page."""
    scene, points = site.viser.server.scene, np.zeros((10_000, 3), dtype=np.float32)
    clouds = [scene.add_point_cloud(f"/test/{number}", points, (0, 0, 0)) for number in range(200)]
    sizes, names = [], set()
    try:
        with site.socket() as browser:
            while len(names) < len(clouds):
                raw = browser.recv(timeout=TIMEOUT_S)
                sizes.append(len(raw))
                names |= {name for m in messages(raw) if (name := str(m.get("name"))).startswith("/test/")}
    finally:
        for cloud in clouds:
            cloud.remove()
    assert sum(sizes) > 12_000_000 and max(sizes) < 2_500_000


@pytest.mark.parametrize("key", [None, "wrong"])
def test_visers_own_port_answers_only_to_the_bridge(site: Site, key: str | None) -> None:
    headers = {"X-Hemislam-Key": key} if key else {}
    with pytest.raises(InvalidStatus) as refused:
        connect(site.viser.url, subprotocols=[PROTOCOL], additional_headers=headers, proxy=None)
    assert refused.value.response.status_code == 403
    assert httpx.get(site.viser.url.replace("ws", "http"), headers=headers).status_code == 403


# --- access ------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "http://127.0.0.1:1", "https://127.0.0.1.evil.example"]
)
def test_a_foreign_origin_is_refused_everywhere(site: Site, origin: str) -> None:
    for path in ("/", "/api/state", "/healthz"):
        assert httpx.get(site.url(path), headers={"Origin": origin}).status_code == 403
    answer = httpx.post(site.url("/api/transport"), json={"action": "play"}, headers={"Origin": origin})
    assert answer.status_code == 403
    with pytest.raises(InvalidStatus):
        site.socket(origin=Origin(origin))


def test_our_own_page_is_let_in(site: Site) -> None:
    own = site.url("")
    assert httpx.get(site.url("/api/state"), headers={"Origin": own}).status_code == 200
    with site.socket(origin=Origin(own)) as browser:
        assert browser.subprotocol == PROTOCOL


def test_a_foreign_name_for_this_machine_is_refused(site: Site) -> None:
    """DNS rebinding: the attacker's name resolves to 127.0.0.1, so Origin and Host agree."""
    host = f"evil.example:{site.port}"
    assert httpx.get(site.url(), headers={"Host": host, "Origin": f"http://{host}"}).status_code == 403
    assert httpx.get(site.url(), headers={"Host": f"localhost:{site.port}"}).status_code == 200


@pytest.mark.parametrize("token", [None, "", "wrong", "the-toke", "the-token2", "ünïcode"])
def test_without_the_token_nothing_is_answered(locked_site: Site, token: str | None) -> None:
    params = {"token": token} if token is not None else {}
    headers = {"Cookie": f"{locked_site.access.cookie}={token}".encode()} if token else {}
    for path in ("/", "/api/state", "/api/openapi.json", "/api/export/map.ply"):
        assert httpx.get(locked_site.url(path), params=params).status_code == 401
        assert httpx.get(locked_site.url(path), headers=headers).status_code == 401
    with pytest.raises(InvalidStatus):
        locked_site.socket()
    assert httpx.get(locked_site.url("/healthz")).json() == {"status": "ok"}


def test_the_link_lets_in_once_and_the_cookie_from_then_on(locked_site: Site) -> None:
    with httpx.Client() as browser:
        answer = browser.get(locked_site.url("/?token=the-token&darkMode=1"))
        assert answer.status_code == 303 and answer.headers["location"] == "/?darkMode=1"
        assert "HttpOnly" in answer.headers["set-cookie"]
        assert browser.get(locked_site.url("/")).status_code == 200
        cookie = "; ".join(f"{name}={value}" for name, value in browser.cookies.items())
    with locked_site.socket(additional_headers={"Cookie": cookie}) as page:
        assert page.subprotocol == PROTOCOL


def test_the_redirect_never_leaves_for_another_host(locked_site: Site) -> None:
    answer = httpx.get(locked_site.url("//evil.example/?token=the-token"))
    assert answer.headers.get("location", "/").startswith("/") and not answer.headers["location"].startswith("//")


def test_scripts_give_the_token_as_a_bearer(locked_site: Site) -> None:
    answer = httpx.get(locked_site.url("/api/state"), headers={"Authorization": "Bearer the-token"})
    assert answer.status_code == 200


def test_the_token_alone_does_not_let_another_site_in(locked_site: Site) -> None:
    headers = {"Authorization": "Bearer the-token", "Origin": "http://evil.example"}
    assert httpx.get(locked_site.url("/api/state"), headers=headers).status_code == 403


@pytest.mark.parametrize(
    ("host", "needed"),
    [
        ("127.0.0.1", False),
        ("localhost", False),
        ("::1", False),
        ("0.0.0.0", True),
        ("192.168.1.5", True),
        ("::", True),
        ("", True),
    ],
)
def test_a_token_is_made_wherever_others_could_reach_us(host: str, needed: bool) -> None:
    access = Access.on(host, 8080)
    assert (access.token is not None) == needed
    assert all((f":8080/?token={access.token}" in address) == needed for address in links(host, access))


# --- the whole server ----------------------------------------------------------------------------
def test_a_busy_port_is_named_with_the_way_out() -> None:
    with listen("127.0.0.1", 0) as busy:
        port = busy.getsockname()[1]
        with pytest.raises(HemislamError, match=f"Port {port} is in use .* --port"):
            listen("127.0.0.1", port)


def test_an_address_that_is_not_ours_is_named() -> None:
    with pytest.raises(HemislamError, match="--host"):
        listen("192.0.2.1", 0)


SERVER = """
import sys
sys.path[:0] = {path!r}
import server_fakes as fakes
from functools import partial
from pathlib import Path
from app.server.folders import Folders
from app.server.web import run_server
from app.server.setup import Setup
from app.server.worker import EngineProcess

class Page:
    parts = ""
    def __init__(self, viser, engine, folders): self.engine = engine
    def start(self): print("engine", self.engine._sides[0].engine.pid, flush=True)
    def close(self): print("page closed", flush=True)

if __name__ == "__main__":
    run_server(
        Setup(recording=Path("walk-300.mcap")), folders=Folders([]), build_page=Page, port=0, open_browser=False,
        start_engine=partial(EngineProcess, main=fakes.fake_main),
    )
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_server_stops_cleanly_with_everything_it_started(tmp_path: Path, number: signal.Signals) -> None:
    script = tmp_path / "server.py"
    script.write_text(SERVER.format(path=[str(Path(__file__).resolve().parents[2]), str(Path(__file__).parent)]))
    process = subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        assert process.stdout is not None
        engine_pid = int(process.stdout.readline().removeprefix("engine "))
        address = process.stdout.readline().split()[3]
        health = f"{address}healthz"
        assert httpx.get(health, timeout=TIMEOUT_S).json() == {"status": "ok"}
        with connect(address.replace("http", "ws"), subprotocols=[PROTOCOL], proxy=None):
            os.killpg(process.pid, number) if number == signal.SIGINT else process.send_signal(number)
            out, err = process.communicate(timeout=TIMEOUT_S)
    finally:
        process.kill()
    assert process.returncode == 0 and err == "" and out == "page closed\n"
    with pytest.raises(ProcessLookupError):
        os.kill(engine_pid, 0)


# --- https, health, the end ----------------------------------------------------------------------
@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> Tls:
    folder = tmp_path_factory.mktemp("tls")
    tls = Tls(folder / "cert.pem", folder / "key.pem")
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "1",
         "-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1",
         "-keyout", str(tls.key), "-out", str(tls.certificate)],
        check=True, capture_output=True, timeout=TIMEOUT_S,
    )  # fmt: skip
    return tls


def test_page_rest_and_websocket_by_https(
    engine: EngineProcess, target: Viser, tmp_path: Path, certificate: Tls
) -> None:
    with serving(engine, target, tmp_path, "for-owners", "for-viewers", certificate) as site:
        trust = ssl.create_default_context(cafile=str(certificate.certificate))
        (link,) = links("localhost", site.access)
        assert link.startswith("https://localhost:")
        with httpx.Client(verify=trust) as browser:
            cookie = browser.get(link.replace("localhost", "127.0.0.1")).headers["set-cookie"]
            assert "Secure" in cookie and "HttpOnly" in cookie
            assert browser.get(f"https://127.0.0.1:{site.port}/api/state", headers=OWNER).status_code == 200
        with ThreadPoolExecutor(1) as beside:  # a browser's event loop may be running in this thread
            address = f"wss://127.0.0.1:{site.port}/"
            assert beside.submit(asyncio.run, _protocol(address, trust)).result() == PROTOCOL
        with pytest.raises(httpx.HTTPError):
            httpx.get(site.url("/healthz"))


async def _protocol(address: str, trust: ssl.SSLContext) -> str | None:
    """In one thread: with the two of websockets' other client, OpenSSL sometimes waits forever."""
    async with asyncio_connect(
        address, ssl=trust, subprotocols=[PROTOCOL], additional_headers=OWNER, proxy=None
    ) as socket:
        return socket.subprotocol


def test_a_certificate_that_cannot_be_used_is_refused_at_once(certificate: Tls, tmp_path: Path) -> None:
    (tmp_path / "no.pem").write_text("nothing")
    for bad in (Tls(tmp_path / "missing.pem"), Tls(tmp_path / "no.pem"), Tls(certificate.certificate)):
        with pytest.raises(HemislamError, match="--certificate and --key"):
            bad.check()


def test_health_is_503_when_the_engine_has_ended_for_good(target: Viser, tmp_path: Path) -> None:
    engine = EngineProcess(Setup(), main=fakes.fake_main)
    with serving(engine, target, tmp_path, None) as site:
        assert httpx.get(site.url("/healthz")).status_code == 200
        assert engine.pid is not None
        os.kill(engine.pid, signal.SIGKILL)
        until(lambda: httpx.get(site.url("/healthz")).status_code == 503)
        assert httpx.get(site.url("/healthz")).json() == {"status": "engine down"}
    engine.close()


def test_a_sigterm_to_the_whole_group_loses_nothing_that_was_received(tmp_path: Path) -> None:
    """As a service manager sends it: to the server, the engine and the receiver at once."""
    msop, difop, imu_port = free_ports(3)
    packets, imu = f"rsbpearl://127.0.0.1:{msop},{difop}", f"imu-udp://127.0.0.1:{imu_port}"
    record = tmp_path / "live.mcap"
    command = [sys.executable, "-m", "app", "serve", "--live", packets, "--imu", imu, "--record", str(record)]
    command += ["--port", "0", "--no-browser", "--log-json", "--set", "loops.enabled=false"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        assert process.stdout is not None
        address = process.stdout.readline().split()[3]
        params = resolve_params(SAMPLE, None, None, [])
        feed(SAMPLE, params, parse_address(packets), parse_address(imu), pace=Pace(2.0), duration_s=4.0)
        with httpx.Client(base_url=address) as client:
            until(lambda: (live := client.get("api/state").json()["live"]) and live["imu_age_s"] > 1.0)
            counted = client.get("api/state").json()["live"]["counters"]
        os.killpg(process.pid, signal.SIGTERM)
        _, err = process.communicate(timeout=TIMEOUT_S)
    finally:
        process.kill()
    assert process.returncode == 0
    entries = [json.loads(line) for line in err.splitlines()]
    assert "Traceback" not in err and entries[-1]["message"] == "Ending"
    assert {entry["process"] for entry in entries} >= {"server", "live"}
    with record.open("rb") as file:
        found = make_reader(file).get_summary()
    assert found is not None and found.statistics is not None, "the file has its end"
    topics = {channel.topic: found.statistics.channel_message_counts[n] for n, channel in found.channels.items()}
    assert counted["frames"] > 30 and counted["imu"] > 700
    assert sorted(topics.values()) == [counted["frames"], counted["imu"]]
