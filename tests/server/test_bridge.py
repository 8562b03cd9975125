"""Messages that a page may send to viser: only its camera if it is view-only, and no upload that is too large."""

import os
from collections.abc import Iterator
from typing import Any

import httpx
import msgspec
import pytest
import zstandard
from server_site import CAMERA, OWNER, TIMEOUT_S, VIEWER, Site, packed, until
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection

from app.server.access import MOST_BYTES
from app.server.bridge import Gate, Refused


def page(public_site: Site, headers: dict[str, str]) -> ClientConnection:
    return public_site.socket(additional_headers=headers)


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


def test_in_a_view_only_page_the_controls_do_nothing(public_site: Site) -> None:
    gui = public_site.viser.server.gui
    pressed: list[str] = []
    slider = gui.add_slider("a slider here", min=0, max=10, step=1, initial_value=3)
    button = gui.add_button("a button here")
    button.on_click(lambda _: pressed.append("button"))
    command = gui.add_command("a command here")
    command.on_trigger(lambda _: pressed.append("command"))
    with page(public_site, VIEWER) as viewer, page(public_site, OWNER) as owner:
        uuid = shown(viewer, "a slider here")["uuid"]
        button_uuid = shown(owner, "a button here")["uuid"]

        def act(browser: ClientConnection, value: int) -> None:
            browser.send(packed(type="GuiUpdateMessage", uuid=button_uuid, updates={"value": True}))
            browser.send(packed(type="CommandTriggerMessage", uuid=command._impl.uuid))
            browser.send(packed(type="GuiUpdateMessage", uuid=uuid, updates={"value": value}))

        act(viewer, 9)
        viewer.send(packed(**CAMERA))  # comes after, and is let through: so what came before was read
        until(lambda: len(public_site.viser.server.get_clients()) >= 1)
        assert slider.value == 3 and pressed == []
        owner.send(packed(**CAMERA))
        until(lambda: len(public_site.viser.server.get_clients()) >= 2)
        act(owner, 7)
        until(lambda: slider.value == 7 and sorted(pressed) == ["button", "command"])
    slider.remove()
    button.remove()


@pytest.mark.parametrize("viewer", [False, True])
@pytest.mark.parametrize("kind", ["ShareUrlRequest", "ShareUrlDisconnect"])
def test_nobody_can_ask_for_visers_public_tunnel(kind: str, viewer: bool) -> None:
    assert Gate(viewer=viewer).let(packed(type=kind)) is None


def test_a_message_that_could_be_read_in_two_ways_reaches_viser_in_one() -> None:
    """A map with the same key twice: harmless as one of them, a command as the other."""
    update = [("uuid", "x"), ("updates", {})]
    entries = [("type", "ViewerCameraMessage"), *update, ("type", "GuiUpdateMessage")]
    two = bytes([0x80 | len(entries)]) + b"".join(msgspec.msgpack.encode(part) for entry in entries for part in entry)
    for order in (two, two.replace(b"ViewerCameraMessage", b"GuiUpdateMessage___"[:19])):
        try:
            let = Gate(viewer=True).let(order)
        except Refused:
            continue
        assert let is None or (let.count(b"type") == 1 and b"GuiUpdate" not in let)


@pytest.mark.parametrize(
    "raw", [b"", b"\xc1", b"no message", b"\x93\x01\x02\x03", packed(type=[1]), packed(), os.urandom(200)]
)
def test_a_malformed_message_ends_its_connection_and_nothing_else(public_site: Site, raw: bytes) -> None:
    with page(public_site, OWNER) as browser:
        browser.send(raw)
        with pytest.raises(ConnectionClosed):
            while True:
                browser.recv(timeout=TIMEOUT_S)
    assert httpx.get(public_site.url("/healthz")).status_code == 200


NESTED = bytes([0x82]) + msgspec.msgpack.encode("type") + msgspec.msgpack.encode("ViewerCameraMessage")
NESTED += msgspec.msgpack.encode("fov") + b"\x91" * 100_000 + b"\x01"
"""A camera whose field of view is a list in a list in a list ..."""


@pytest.mark.parametrize(
    "raw",
    [
        *(packed(**CAMERA | {name: value}) for name in CAMERA if name != "type" for value in (None, "x", [], {}, [1])),
        packed(**CAMERA | {"position": (0.0, float("nan"), 0.0)}),
        packed(**CAMERA | {"fov": float("inf")}),
        packed(**CAMERA | {"position": (0.0, 0.0)}),
        packed(**CAMERA | {"near": 1e300}),
        packed(**CAMERA | {"more": 1}),
        packed(type="ViewerCameraMessage"),
        packed(type="NoMessageAtAll"),
        NESTED,
    ],
)
def test_a_camera_that_viser_could_not_read_is_refused(raw: bytes) -> None:
    with pytest.raises(Refused) as refused:
        assert Gate(viewer=False).let(raw) == b"never"
    assert refused.value.code == 1007


def test_a_good_camera_is_let_through() -> None:
    for viewer in (False, True):
        let = Gate(viewer=viewer).let(packed(**CAMERA))
        assert let is not None and msgspec.msgpack.decode(let)["image_width"] == 100


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
    public_site: Site, size: int, parts: list[bytes], codes: set[int]
) -> None:
    with page(public_site, OWNER) as browser:
        with pytest.raises(ConnectionClosed):
            for message in upload(size, parts):
                browser.send(message)
            while True:
                browser.recv(timeout=TIMEOUT_S)
        assert browser.close_code in codes


def test_a_file_of_a_sensible_size_arrives(public_site: Site) -> None:
    button = public_site.viser.server.gui.add_upload_button("an upload here")
    with page(public_site, OWNER) as browser:
        browser.send(packed(**CAMERA))
        uuid = shown(browser, "an upload here")["uuid"]
        content = os.urandom(100_000)
        for message in upload(len(content), [content[:60_000], content[60_000:]]):
            browser.send(msgspec.msgpack.encode(msgspec.msgpack.decode(message) | {"source_component_uuid": uuid}))
        until(lambda: button.value.content == content)
        assert button.value.content == content
    button.remove()


def test_only_a_picture_that_an_owner_s_page_rendered_may_be_large() -> None:
    large = b"x" * (3 * MOST_BYTES)
    picture = packed(type="GetRenderResponseMessage", render_uuid="one", payload=large)
    assert Gate(viewer=False).let(picture) is not None
    for viewer, message in (
        (True, picture),
        (False, packed(type="GuiUpdateMessage", uuid="one", updates={"value": large})),
    ):
        with pytest.raises(Refused):
            Gate(viewer=viewer).let(message)


def test_uploads_that_never_end_do_not_pile_up() -> None:
    gate = Gate(viewer=False)
    with pytest.raises(Refused):
        for n in range(20):
            gate.let(packed(type="FileTransferStartUpload", transfer_uuid=str(n), size_bytes=MOST_BYTES))
    assert gate.let(packed(type="FileTransferPart", transfer_uuid="of nobody", content=b"x")) is None
    assert gate.let(packed(type="FileTransferPart", transfer_uuid="0", content=b"")) is None
