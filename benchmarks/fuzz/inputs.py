"""Damaged packets, session files, YAML and messages of a page: each is refused with a sentence, or accepted."""

import json
import random
import tempfile
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from viser.infra import Message

from app.mapping.session_file import Opened, SavedSession, State, read_session, size_of, write_session
from app.sensors.cloud_types import LIVOX_CUSTOM_MSGS, POINT_CLOUD_2
from app.sensors.live.urls import parse_address
from app.sensors.livox import CustomMsg
from app.sensors.source import Source
from app.server.bridge import Gate, Refused
from app.slam.errors import HemislamError
from app.slam.loops import edit_files
from app.slam.params import Params
from benchmarks.fuzz.damage import HUGE, bytes_damaged
from benchmarks.fuzz.recordings import Packet, pcap

PACKETS_AT_ONCE = 1000


def _refused_well(error: HemislamError) -> str:
    sentence = str(error)
    bad = "\n" in sentence.rstrip() or "Traceback" in sentence or len(sentence) < 15
    return f"not a sentence: {sentence[:300]}" if bad else ""


def packets(seed: int, good: list[Packet]) -> str:
    """A capture of a thousand packets, a third of them damaged, reordered or repeated; reading yields finite points."""
    luck = random.Random(seed)
    first = luck.randrange(max(len(good) - PACKETS_AT_ONCE, 1))
    chosen = good[first : first + PACKETS_AT_ONCE]
    made = [
        (time_ns, port, bytes_damaged(luck, data) if luck.random() < 0.3 else data) for time_ns, port, data in chosen
    ]
    for _ in range(luck.choice([0, 10, 200])):
        a, b = luck.randrange(len(made)), luck.randrange(len(made))
        made[a], made[b] = made[b], made[luck.choice([a, b])]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "case.pcap"
        path.write_bytes(pcap(made))
        try:
            with Source(path) as source:
                for _, _, message in source.messages(tuple(topic.name for topic in source.topics)):
                    if isinstance(message, CustomMsg) or (hasattr(message, "data") and message.width):
                        kind = LIVOX_CUSTOM_MSGS[0] if isinstance(message, CustomMsg) else POINT_CLOUD_2
                        points = kind.read(message).xyz()
                        if np.isinf(points).any() or np.nanmax(np.abs(points), initial=0) > 1e4:
                            return "points beyond all ranges"
        except HemislamError as error:
            return _refused_well(error)
    return ""


def session(seed: int, recording: Path) -> str:
    """A session file with damaged bytes or values."""
    luck = random.Random(seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "case.hemislam"
        state = State(Params().with_values({"ground.alpha": 30.0}))
        write_session(path, SavedSession(Opened(recording, nbytes=size_of(recording)), state, 5, ended=False))
        data = path.read_bytes()
        if luck.random() < 0.5:
            data = bytes_damaged(luck, data)
        else:
            lines = [json.loads(line) for line in data.splitlines()]
            for _ in range(luck.choice([1, 1, 3])):
                lines[luck.randrange(len(lines))] = _changed(luck, luck.choice(lines))
            data = b"".join(json.dumps(line).encode() + b"\n" for line in lines)
        path.write_bytes(data)
        try:
            read_session(path)
        except HemislamError as error:
            return _refused_well(error)
    return ""


def text(seed: int) -> str:
    """Parameters, loop edits and addresses as typed by a user, then damaged."""
    luck = random.Random(seed)
    kind = luck.randrange(3)
    good = (Params().to_yaml(), "- accept: [0, 5]\n- reject: [3, 9]\n", "rsbpearl://192.168.1.102:6699,7788")[kind]
    try:
        if kind == 0 and luck.random() < 0.5:
            sections: dict[str, Any] = Params().model_dump(mode="json")
            Params().merged(_changed(luck, sections))
            return ""
        said = bytes_damaged(luck, good.encode()).decode(errors=luck.choice(["replace", "ignore", "surrogateescape"]))
        if kind == 0:
            Params().merged_yaml(said)
        elif kind == 1:
            edit_files.read(said)
        else:
            parse_address(said)
    except HemislamError as error:
        return _refused_well(error)
    return ""


def page(seed: int) -> str:
    """A damaged message of a page: the gate refuses it, or viser can read it."""
    luck = random.Random(seed)
    values: dict[str, Any] = {"wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.0, 0.0, 0.0), "fov": 1.0, "near": 0.1}
    values |= {"far": 100.0, "image_height": 100, "image_width": 100, "look_at": (1.0, 0.0, 0.0)}
    camera = {"type": "ViewerCameraMessage", **values, "up_direction": (0.0, 0.0, 1.0)}
    update = {"type": "GuiUpdateMessage", "uuid": "some", "updates": {"value": 1.5}}
    upload: dict[str, Any] = {
        "type": "FileTransferStartUpload",
        "source_component_uuid": "a",
        "transfer_uuid": "b",
        "filename": "c",
    }
    upload |= {"mime_type": "text/yaml", "part_count": 1, "size_bytes": 10}
    message = luck.choice([camera, camera, update, upload])
    raw = msgspec.msgpack.encode(_changed(luck, message))
    if luck.random() < 0.5:
        raw = bytes_damaged(luck, raw)
    if luck.random() < 0.05:
        raw = b"\x81\xa1a" + luck.choice([b"\x91", b"\x81\xa1a"]) * 50_000 + b"\x01"
    try:
        passed = Gate(viewer=luck.random() < 0.5).let(raw)
    except Refused:
        return ""
    if passed is not None:
        Message.deserialize(passed)
    return ""


def _changed(luck: random.Random, value: Any) -> Any:
    """The same tree with one part replaced, removed or added."""
    odd: Any = luck.choice([None, "", "x" * 3000, True, [], {}, [[]], -1, 2**63 - 1, *HUGE, {"a": 1}, "\x1b[2J", "1.5"])
    if luck.random() < 0.2 or not isinstance(value, dict | list | tuple) or not value:
        return odd
    if isinstance(value, dict):
        name = luck.choice(list(value))
        if luck.random() < 0.2:
            return {key: one for key, one in value.items() if key != name} | luck.choice([{}, {"more": odd}])
        return value | {name: _changed(luck, value[name])}
    at = luck.randrange(len(value))
    return [*value[:at], _changed(luck, value[at]), *value[at + luck.choice([1, 1, 1, 0]) :]]
