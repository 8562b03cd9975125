"""What is refused, over real sockets: commands of view-only pages, and all that is too large; https; the logs."""

import asyncio
import json
import os
import signal
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import msgspec
import pytest
import server_fakes as fakes
import zstandard
from mcap.reader import make_reader
from server_site import PROTOCOL, TIMEOUT_S, Site
from test_live_run import free_ports
from test_rewind import SAMPLE
from websockets.asyncio.client import connect as asyncio_connect
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection
from websockets.typing import Origin

from app.logs import JsonLines
from app.sensors.live.feed import Pace, feed
from app.sensors.live.urls import parse_address
from app.sensors.presets import resolve_params
from app.server.access import MOST_BYTES, Access
from app.server.address import links, listen
from app.server.bridge import Gate, Refused
from app.server.folders import Folders
from app.server.setup import Setup
from app.server.viser_adapter import Viser, start_viser
from app.server.web import Tls, make_app, make_server
from app.server.worker import EngineProcess
from app.slam.errors import HemislamError

VIEWER = {"Authorization": "Bearer for-viewers"}
OWNER = {"Authorization": "Bearer for-owners"}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """A server as on a public address, with both tokens."""
    recording = tmp_path_factory.mktemp("recordings") / "walk-60.mcap"
    recording.write_bytes(b"x")
    engine = EngineProcess(Setup(recording=recording), main=fakes.fake_main)
    target = start_viser()
    listener = listen("127.0.0.1", 0)
    access = Access(listener.getsockname()[1], "for-owners", "for-viewers")
    server = make_server(make_app(engine, Folders([recording.parent]), target, access))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    until(lambda: engine.snapshot.recording is not None)
    yield Site(access.port, engine, target, recording.parent, access)
    server.should_exit = True
    thread.join()
    listener.close()
    target.stop()
    engine.close()


def until(true: Any) -> None:
    deadline = time.monotonic() + TIMEOUT_S
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def packed(**message: Any) -> bytes:
    return msgspec.msgpack.encode(message)


def page(site: Site, headers: dict[str, str]) -> ClientConnection:
    return site.socket(additional_headers=headers)


def shown(browser: ClientConnection, label: str) -> dict[str, Any]:
    """The message by which viser shows the control with this label."""
    while True:
        raw = browser.recv(timeout=TIMEOUT_S)
        assert isinstance(raw, bytes)
        size = int.from_bytes(raw[8:16], "little")
        unpacked = zstandard.ZstdDecompressor().decompress(raw[16 : 16 + size])
        for message in msgspec.msgpack.decode(unpacked)["messages"]:
            if message.get("props", {}).get("label") == label:
                found: dict[str, Any] = message
                return found


# --- view only ----------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("method", "path", "body"),
    [
        ("POST", "/api/transport", {"action": "play"}),
        ("PATCH", "/api/params", {"ground": {"alpha": 31}}),
        ("POST", "/api/recordings", {"path": "walk-60.mcap"}),
        ("PUT", "/", None),
        ("DELETE", "/api/state", None),
    ],
)
def test_the_view_only_token_changes_nothing_by_rest(site: Site, method: str, path: str, body: Any) -> None:
    before = site.engine.snapshot.params
    answer = httpx.request(method, site.url(path), json=body, headers=VIEWER)
    assert answer.status_code == 403 and "view only" in answer.text
    assert site.engine.snapshot.params == before


def test_the_view_only_token_sees_the_state_and_the_page(site: Site) -> None:
    for path in ("/api/state", "/api/params", "/api/openapi.json"):
        assert httpx.get(site.url(path), headers=VIEWER).status_code == 200
    seen, owned = (httpx.get(site.url(), headers=headers).text for headers in (VIEWER, OWNER))
    assert "View only" in seen and "View only" not in owned


def test_in_a_view_only_page_the_controls_do_nothing(site: Site) -> None:
    gui = site.viser.server.gui
    pressed: list[str] = []
    slider = gui.add_slider("a slider here", min=0, max=10, step=1, initial_value=3)
    button = gui.add_button("a button here")
    button.on_click(lambda _: pressed.append("button"))
    command = gui.add_command("a command here")
    command.on_trigger(lambda _: pressed.append("command"))
    with page(site, VIEWER) as viewer, page(site, OWNER) as owner:
        uuid = shown(viewer, "a slider here")["uuid"]
        button_uuid = shown(owner, "a button here")["uuid"]

        def act(browser: ClientConnection, value: int) -> None:
            browser.send(packed(type="GuiUpdateMessage", uuid=button_uuid, updates={"value": True}))
            browser.send(packed(type="CommandTriggerMessage", uuid=command._impl.uuid))
            browser.send(packed(type="GuiUpdateMessage", uuid=uuid, updates={"value": value}))

        act(viewer, 9)
        viewer.send(packed(**CAMERA))  # comes after, and is let through: so what came before was read
        until(lambda: len(site.viser.server.get_clients()) >= 1)
        assert slider.value == 3 and pressed == []
        owner.send(packed(**CAMERA))
        until(lambda: len(site.viser.server.get_clients()) >= 2)
        act(owner, 7)
        until(lambda: slider.value == 7 and sorted(pressed) == ["button", "command"])
    slider.remove()
    button.remove()


CAMERA: dict[str, Any] = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, 0.0),
    "fov": 1.0,
    "near": 0.1,
    "far": 100.0,
    "image_height": 100,
    "image_width": 100,
    "look_at": (1.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}


@pytest.mark.parametrize("viewer", [False, True])
@pytest.mark.parametrize("kind", ["ShareUrlRequest", "ShareUrlDisconnect"])
def test_nobody_can_ask_for_visers_public_tunnel(kind: str, viewer: bool) -> None:
    assert Gate(viewer=viewer).let(packed(type=kind)) is None


def test_a_message_that_could_be_read_in_two_ways_reaches_viser_in_one() -> None:
    """A map with the same key twice: harmless as one of them, a command as the other."""
    entries = [("type", "ViewerCameraMessage"), ("uuid", "x"), ("type", "GuiUpdateMessage")]
    two = bytes([0x80 | len(entries)]) + b"".join(msgspec.msgpack.encode(part) for entry in entries for part in entry)
    for order in (two, two.replace(b"ViewerCameraMessage", b"GuiUpdateMessage___"[:19])):
        let = Gate(viewer=True).let(order)
        assert let is None or (let.count(b"type") == 1 and b"GuiUpdate" not in let)


@pytest.mark.parametrize(
    "raw", [b"", b"\xc1", b"no message", b"\x93\x01\x02\x03", packed(type=[1]), packed(), os.urandom(200)]
)
def test_a_malformed_message_ends_its_connection_and_nothing_else(site: Site, raw: bytes) -> None:
    with page(site, OWNER) as browser:
        browser.send(raw)
        with pytest.raises(ConnectionClosed):
            while True:
                browser.recv(timeout=TIMEOUT_S)
    assert httpx.get(site.url("/healthz")).status_code == 200


def test_the_view_only_link_makes_nobody_an_owner(site: Site) -> None:
    with httpx.Client() as browser:
        answer = browser.get(site.url("/?token=for-viewers"))
        assert answer.status_code == 303 and "for-viewers" in answer.headers["set-cookie"]
        for query in ("?token=wrong", "?token=", "?token=for-owner", "?token=for-viewers&token=wrong"):
            browser.get(site.url(f"/{query}"))
            assert "for-owners" not in str(browser.cookies)
        assert browser.post(site.url("/api/transport"), json={"action": "play"}).status_code == 403
        assert browser.get(site.url("/?token=for-owners")).status_code == 303
        assert browser.post(site.url("/api/transport"), json={"action": "pause"}).status_code == 202


def test_the_view_only_token_does_not_let_another_site_in(site: Site) -> None:
    evil = "http://evil.example"
    assert httpx.get(site.url("/api/state"), headers=VIEWER | {"Origin": evil}).status_code == 403
    with pytest.raises(InvalidStatus):
        site.socket(additional_headers=VIEWER, origin=Origin(evil))
    with pytest.raises(InvalidStatus):
        site.socket(additional_headers={"Authorization": "Bearer wrong"})


def test_the_two_tokens_differ_and_exist_only_where_others_could_reach_us() -> None:
    public = Access.on("0.0.0.0", 1)
    assert public.token and public.viewer_token and public.token != public.viewer_token
    assert Access.on("127.0.0.1", 1).viewer_token is None
    assert all(public.token not in link for link in links("0.0.0.0", public, public.viewer_token))


# --- size limits ---------------------------------------------------------------------------------
def test_a_body_that_is_too_large_is_refused_with_or_without_its_length(site: Site) -> None:
    large = b" " * (MOST_BYTES + 1)
    announced = httpx.post(site.url("/api/transport"), content=large, headers=OWNER)
    assert announced.status_code == 413

    def parts() -> Iterator[bytes]:
        for _ in range(4):
            yield large[: MOST_BYTES // 2]

    chunked = httpx.post(
        site.url("/api/transport"), content=parts(), headers=OWNER | {"Content-Type": "application/json"}
    )
    assert chunked.status_code == 413


def upload(size: int, parts: list[bytes]) -> Iterator[bytes]:
    common = {"source_component_uuid": "some-button", "transfer_uuid": "one"}
    about = {"filename": "a.yaml", "mime_type": "text/yaml", "part_count": len(parts), "size_bytes": size}
    yield packed(type="FileTransferStartUpload", **common, **about)
    for index, content in enumerate(parts):
        yield packed(type="FileTransferPart", **common, part_index=index, content=content)


@pytest.mark.parametrize(
    ("size", "parts", "codes"),
    [
        (MOST_BYTES + 1, [], {1009}),
        (-1, [], {1009}),
        (10, [b"x" * 8, b"x" * 8], {1009}),
        # Closed while most of the message is still under way, so the reset may overtake the close frame.
        (1000, [b"x" * (3 * MOST_BYTES)], {1009, 1006}),
    ],
    ids=["too large", "negative", "more than announced", "too large a message"],
)
def test_a_file_that_is_too_large_ends_the_connection(
    site: Site, size: int, parts: list[bytes], codes: set[int]
) -> None:
    with page(site, OWNER) as browser:
        with pytest.raises(ConnectionClosed):
            for message in upload(size, parts):
                browser.send(message)
            while True:
                browser.recv(timeout=TIMEOUT_S)
        assert browser.close_code in codes


def test_a_file_of_a_sensible_size_arrives(site: Site) -> None:
    button = site.viser.server.gui.add_upload_button("an upload here")
    with page(site, OWNER) as browser:
        browser.send(packed(**CAMERA))
        uuid = shown(browser, "an upload here")["uuid"]
        content = os.urandom(100_000)
        for message in upload(len(content), [content[:60_000], content[60_000:]]):
            browser.send(msgspec.msgpack.encode(msgspec.msgpack.decode(message) | {"source_component_uuid": uuid}))
        until(lambda: button.value.content == content)
        assert button.value.content == content
    button.remove()


def test_uploads_that_never_end_do_not_pile_up() -> None:
    gate = Gate(viewer=False)
    with pytest.raises(Refused):
        for n in range(20):
            gate.let(packed(type="FileTransferStartUpload", transfer_uuid=str(n), size_bytes=MOST_BYTES))
    assert gate.let(packed(type="FileTransferPart", transfer_uuid="of nobody", content=b"x")) is None
    assert gate.let(packed(type="FileTransferPart", transfer_uuid="0", content=b"")) is None


# --- https ---------------------------------------------------------------------------------------
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


def test_page_rest_and_websocket_by_https(site: Site, certificate: Tls) -> None:
    listener = listen("127.0.0.1", 0)
    access = Access(listener.getsockname()[1], "for-owners", "for-viewers", secure=True)
    server = make_server(make_app(site.engine, Folders([site.folder]), site.viser, access), certificate)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        trust = ssl.create_default_context(cafile=str(certificate.certificate))
        (link,) = links("localhost", access)
        assert link.startswith("https://localhost:")
        with httpx.Client(verify=trust) as browser:
            cookie = browser.get(link.replace("localhost", "127.0.0.1")).headers["set-cookie"]
            assert "Secure" in cookie and "HttpOnly" in cookie
            assert browser.get(f"https://127.0.0.1:{access.port}/api/state", headers=OWNER).status_code == 200
        address = f"wss://127.0.0.1:{access.port}/"
        with ThreadPoolExecutor(1) as beside:  # here a browser's loop may be running
            assert beside.submit(asyncio.run, _protocol(address, trust)).result() == PROTOCOL
        with pytest.raises(httpx.HTTPError):
            httpx.get(f"http://127.0.0.1:{access.port}/healthz")
    finally:
        server.should_exit = True
        thread.join()
        listener.close()


async def _protocol(address: str, trust: ssl.SSLContext) -> str | None:
    """By one thread: with two, that of websockets' other client, OpenSSL now and then waits for ever."""
    async with asyncio_connect(
        address, ssl=trust, subprotocols=[PROTOCOL], additional_headers=OWNER, proxy=None
    ) as socket:
        return socket.subprotocol


def test_a_certificate_that_cannot_be_used_is_refused_at_once(certificate: Tls, tmp_path: Path) -> None:
    (tmp_path / "no.pem").write_text("nothing")
    for bad in (Tls(tmp_path / "missing.pem"), Tls(tmp_path / "no.pem"), Tls(certificate.certificate)):
        with pytest.raises(HemislamError, match="--certificate and --key"):
            bad.check()


# --- logs ----------------------------------------------------------------------------------------
def test_a_refusal_is_logged_as_one_line_of_json_without_the_token(site: Site, caplog: Any) -> None:
    httpx.get(site.url("/api/state?token=my-guess"))
    (record,) = [record for record in caplog.records if record.name == "app.server.access"]
    (line,) = JsonLines("server").format(record).splitlines()
    entry = json.loads(line)
    assert entry["level"] == "warning" and entry["status"] == 401 and "127.0.0.1" in entry["message"]
    assert "my-guess" not in line


def test_health_is_503_when_the_engine_has_ended_for_good() -> None:
    listener = listen("127.0.0.1", 0)
    engine, target = EngineProcess(Setup(), main=fakes.fake_main), Viser(None, "")  # type: ignore[arg-type]
    server = make_server(make_app(engine, Folders([]), target, Access(listener.getsockname()[1])))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        health = f"http://127.0.0.1:{listener.getsockname()[1]}/healthz"
        assert httpx.get(health).status_code == 200
        assert engine.pid is not None
        os.kill(engine.pid, signal.SIGKILL)
        until(lambda: httpx.get(health).status_code == 503)
        assert httpx.get(health).json() == {"status": "engine down"}
    finally:
        server.should_exit = True
        thread.join()
        listener.close()
        engine.close()


# --- the end -------------------------------------------------------------------------------------
def test_a_sigterm_to_the_whole_group_loses_nothing_that_was_received(tmp_path: Path) -> None:
    """As a service manager sends it: to the server, the engine and the receiver at once."""
    msop, difop, imu_port = free_ports(3)
    packets, imu = f"rsbpearl://127.0.0.1:{msop},{difop}", f"imu-udp://127.0.0.1:{imu_port}"
    record = tmp_path / "live.mcap"
    command = [sys.executable, "-m", "app", "serve", "--live", packets, "--imu", imu, "--record", str(record)]
    command += ["--port", "0", "--no-browser", "--log-json"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        assert process.stdout is not None
        address = process.stdout.readline().split()[3]
        params = resolve_params(SAMPLE, None, None, [])
        feed(SAMPLE, params, parse_address(packets), parse_address(imu), pace=Pace(2.0), duration_s=4.0)
        until(lambda: (live := httpx.get(f"{address}api/state").json()["live"]) and live["imu_age_s"] > 1.0)
        counted = httpx.get(f"{address}api/state").json()["live"]["counters"]
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
