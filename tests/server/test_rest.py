"""The REST interface over a real socket.

Tests app/server/api.py.
"""

import socket
import time
from pathlib import Path

import httpx
import numpy as np
import pytest
import server_fakes as fakes
from server_site import TIMEOUT_S, Site, eventually

from app.export.map_file import VERTEX
from app.mapping.breakpoints import Breakpoints


def test_transport_by_rest(site: Site) -> None:
    def post(**body: object) -> int:
        return httpx.post(site.url("/api/transport"), json=body).status_code

    assert post(action="seek", frame=7) == 202
    eventually(site, frame=7, playing=False)
    assert post(action="step") == 202
    eventually(site, frame=8)
    assert post(action="speed", factor="max") == 202
    assert post(action="play") == 202
    eventually(site, finished=True, frame=59, speed="max")
    assert post(action="restart") == 202
    assert post(action="pause") == 202
    eventually(site, finished=False, playing=False)
    for bad in (
        {"action": "fly"},
        {"action": "seek"},
        {"action": "speed", "factor": 0},
        {"action": "step", "frames": -1},
        {"action": "step", "count": 5},
    ):
        assert post(**bad) == 422


def test_parameters_by_rest(site: Site) -> None:
    answer = httpx.patch(site.url("/api/params"), json={"ground": {"alpha": 31}})
    assert answer.json()["ground"]["alpha"] == 31
    deadline = time.monotonic() + TIMEOUT_S
    while httpx.get(site.url("/api/params")).json()["ground"]["alpha"] != 31:
        assert time.monotonic() < deadline
    refused = httpx.patch(site.url("/api/params"), json={"ground": {"alpha": 900}})
    assert refused.status_code == 422 and "`ground.alpha` cannot be 900" in refused.json()["detail"]
    schemas = httpx.get(site.url("/api/openapi.json")).json()["components"]["schemas"]
    schema = schemas["GroundParams"]["properties"]["alpha"]
    assert schema["minimum"] == 1 and schema["maximum"] == 90 and schema["unit"] == "deg"


def test_comparing_by_rest(site: Site) -> None:
    answer = httpx.post(site.url("/api/truth"), json={"path": "../secret.tum"})
    assert answer.status_code == 422 and "There is no" in answer.json()["detail"]
    assert httpx.post(site.url("/api/truth"), json={"path": None}).status_code == 202


def test_exports_by_rest(site: Site) -> None:
    httpx.post(site.url("/api/transport"), json={"action": "seek", "frame": 20})
    eventually(site, frame=20)
    trajectory = httpx.get(site.url("/api/export/trajectory.tum"), timeout=TIMEOUT_S).text.splitlines()
    assert len(trajectory) == 21 and all(len(line.split()) == 8 for line in trajectory)
    cloud = httpx.get(site.url("/api/export/map.ply"), timeout=TIMEOUT_S).content
    assert f"element vertex {5 * fakes.POINTS:012d}".encode() in cloud
    assert not [text for text in notices(site) if "hemislam-export" in text], "the folder is gone already"
    assert httpx.get(site.url("/api/export/passwd")).status_code == 422
    for name in ("trajectory.gpx", "map.kmz"):
        refused = httpx.get(site.url(f"/api/export/{name}"))
        assert refused.status_code == 409 and "needs a georeferenced map" in refused.json()["detail"]
    refused = httpx.get(site.url("/api/export/section.svg"), timeout=TIMEOUT_S)
    assert refused.status_code == 409 and "box" in refused.json()["detail"]
    for name, status in (("graph.g2o", 409), ("loops.csv", 404)):
        without_loops = httpx.get(site.url(f"/api/export/{name}"), timeout=TIMEOUT_S)
        assert without_loops.status_code == status and "loop search is off" in without_loops.json()["detail"]


def test_labels_by_rest(site: Site) -> None:
    httpx.post(site.url("/api/transport"), json={"action": "seek", "frame": 20})
    eventually(site, frame=20)

    def ground() -> int:
        cloud = httpx.get(site.url("/api/export/map.ply"), timeout=TIMEOUT_S).content
        head, _, body = cloud.partition(b"end_header\n")
        count = int(head.partition(b"element vertex ")[2].split()[0])
        return int(np.frombuffer(body, VERTEX, count)["ground"].sum())

    def post(**body: object) -> int:
        return httpx.post(site.url("/api/labels"), json=body).status_code

    found = ground()
    assert post(action="set", keyframe=0, labels=1) == 202
    assert post(action="set", keyframe=1, labels=[1] * fakes.POINTS) == 202
    assert ground() > found
    assert post(action="undo") == post(action="undo") == 202
    assert ground() == found
    assert post(action="set", keyframe=0, labels=7) == post(action="set", labels=1) == 422


@pytest.mark.parametrize("path", ["/etc/passwd", "../../../../etc/passwd", "missing.mcap"])
def test_recordings_outside_the_folders_are_not_opened(site: Site, path: str) -> None:
    answer = httpx.post(site.url("/api/recordings"), json={"path": path})
    assert answer.status_code == 422 and "There is no" in answer.json()["detail"]


@pytest.mark.parametrize(
    "path", ["/../pyproject.toml", "/%2e%2e/pyproject.toml", "/..%2fpyproject.toml", "/index.html"]
)
def test_only_the_page_is_served(site: Site, path: str) -> None:
    with socket.create_connection(("127.0.0.1", site.port)) as raw:
        raw.sendall(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n".encode())
        assert raw.recv(100).split()[1] == b"404"


def test_recordings_inside_are_listed_and_opened(site: Site) -> None:
    names = httpx.get(site.url("/api/recordings")).json()
    assert [Path(name).name for name in names] == ["walk-30.mcap", "walk-60.mcap"]
    for name in names:
        assert httpx.post(site.url("/api/recordings"), json={"path": name}).status_code == 202
        deadline = time.monotonic() + TIMEOUT_S
        while httpx.get(site.url("/api/state")).json()["recording"]["path"] != name:
            assert time.monotonic() < deadline


# --- breakpoints, notes, loops -------------------------------------------------------------------
def notices(site: Site) -> list[str]:
    return [notice["text"] for notice in httpx.get(site.url("/api/state")).json()["notices"]]


def test_breakpoints_by_rest_reach_the_engine_together(site: Site) -> None:
    for body in ({"no_ground": True, "residual": 0.5}, {"frame_ms": 80}, {}):
        answer = httpx.put(site.url("/api/breakpoints"), json=body)
        assert answer.status_code == 200 and answer.json() == Breakpoints(**body).model_dump()
        deadline = time.monotonic() + TIMEOUT_S
        while site.engine.snapshot.breakpoints != Breakpoints(**body):
            assert time.monotonic() < deadline
        assert httpx.get(site.url("/api/breakpoints")).json() == answer.json()


@pytest.mark.parametrize("body", [{"frame_ms": -1}, {"frame_ms": "slow"}, {"flying": True}])
def test_an_invalid_breakpoint_is_refused(site: Site, body: dict[str, object]) -> None:
    before = httpx.get(site.url("/api/breakpoints")).json()
    assert httpx.put(site.url("/api/breakpoints"), json=body).status_code == 422
    assert httpx.get(site.url("/api/breakpoints")).json() == before


def test_breakpoints_are_described(site: Site) -> None:
    schemas = httpx.get(site.url("/api/openapi.json")).json()["components"]["schemas"]
    described = schemas["Breakpoints"]["properties"]
    assert set(described) == set(Breakpoints.model_fields)
    assert all(entry["description"] for entry in described.values())


def test_a_note_stays_with_its_frame(site: Site) -> None:
    httpx.post(site.url("/api/transport"), json={"action": "seek", "frame": 9})
    eventually(site, frame=9)
    assert httpx.post(site.url("/api/notes"), json={"text": "  the door opens "}).status_code == 202
    deadline = time.monotonic() + TIMEOUT_S
    while not (notes := httpx.get(site.url("/api/state")).json()["notes"]):
        assert time.monotonic() < deadline
    assert notes[-1] == {"frame": 9, "text": "the door opens"}
    assert httpx.post(site.url("/api/notes"), json={"text": ""}).status_code == 422
    assert httpx.post(site.url("/api/notes"), json={"text": "a\0b"}).status_code == 422
    assert httpx.post(site.url("/api/notes"), json={"text": "a door", "frame": 3}).status_code == 422
    there = f"/api/notes/{len(notes) - 1}"
    assert httpx.put(site.url(there), json={"text": "it closes"}).status_code == 202
    while httpx.get(site.url("/api/state")).json()["notes"][-1:] != [{"frame": 9, "text": "it closes"}]:
        assert time.monotonic() < deadline
    assert httpx.delete(site.url(there)).status_code == 202
    while len(httpx.get(site.url("/api/state")).json()["notes"]) == len(notes):
        assert time.monotonic() < deadline
    assert httpx.delete(site.url("/api/notes/999")).status_code == 404


def test_an_edit_that_has_no_effect_is_noticed(site: Site) -> None:
    assert httpx.get(site.url("/api/loops")).json() == {"loops": [], "edits": [], "undone": []}
    before = len(notices(site))
    for action in ({"action": "reject", "older": 1, "newer": 5}, {"action": "solve"}):
        assert httpx.post(site.url("/api/loops"), json=action).status_code == 202
    deadline = time.monotonic() + TIMEOUT_S
    while sum("The loop search is off" in text for text in notices(site)[before:]) < 2:
        assert time.monotonic() < deadline
    for bad in ({"action": "reject", "older": 1}, {"action": "weigh", "older": 1, "newer": 5, "weight": 0}):
        assert httpx.post(site.url("/api/loops"), json=bad).status_code == 422
