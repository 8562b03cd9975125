"""Ways to damage messages, files and bytes. Each function takes a random generator and changes its input."""

import copy
import random
from collections.abc import Callable
from typing import Any

import numpy as np

from app.sensors.ros import IMU_TOPIC, LIDAR_TOPIC

Entry = tuple[str, int, Any]
"""Topic, log time in ns, message."""

HUGE = (1e3, 5e3, 1e9, 1e30, 1e300, float("inf"), float("nan"), 0.0, -1e9)


def imu_samples(entries: list[Entry]) -> list[Any]:
    return [message for topic, _, message in entries if topic == IMU_TOPIC]


def clouds(entries: list[Entry]) -> list[Any]:
    return [message for topic, _, message in entries if topic == LIDAR_TOPIC]


def _part(luck: random.Random, things: list[Any]) -> list[Any]:
    """Choose one element, some, a stretch, or all."""
    share = luck.choice([0.0, 0.0, 0.01, 0.1, 0.5, 1.0])
    if luck.random() < 0.5:
        return luck.sample(things, max(1, round(share * len(things))))
    first = luck.randrange(len(things))
    return things[first : first + max(1, round(share * len(things)))]


def _vector(luck: random.Random, sample: Any) -> Any:
    return luck.choice([sample.angular_velocity, sample.linear_acceleration])


def imu_spikes(luck: random.Random, entries: list[Entry]) -> None:
    value = luck.choice([*HUGE, luck.uniform(-600, 600), luck.uniform(-20, 20)])
    for sample in _part(luck, imu_samples(entries)):
        setattr(_vector(luck, sample), luck.choice("xyz"), value)


def imu_scaled(luck: random.Random, entries: list[Entry]) -> None:
    which, factor = (
        luck.choice(["angular_velocity", "linear_acceleration"]),
        luck.choice([57.3, 0.01745, 0.102, 102, 0]),
    )
    for sample in imu_samples(entries):
        vector = getattr(sample, which)
        vector.x, vector.y, vector.z = vector.x * factor, vector.y * factor, vector.z * factor


def imu_axes(luck: random.Random, entries: list[Entry]) -> None:
    which, order = luck.choice(["angular_velocity", "linear_acceleration"]), luck.sample("xyz", 3)
    signs = luck.choices([1, -1], k=3)
    for sample in imu_samples(entries):
        vector = getattr(sample, which)
        values = [sign * getattr(vector, axis) for axis, sign in zip(order, signs, strict=True)]
        vector.x, vector.y, vector.z = values


def imu_stuck(luck: random.Random, entries: list[Entry]) -> None:
    samples, axis, number = imu_samples(entries), luck.choice("xyz"), luck.randrange(2)
    samples = samples[luck.choice([0, len(samples) // 2]) :]
    held = getattr((samples[0].angular_velocity, samples[0].linear_acceleration)[number], axis)
    for sample in samples:
        setattr((sample.angular_velocity, sample.linear_acceleration)[number], axis, held)


def stamps(luck: random.Random, entries: list[Entry]) -> None:
    shift = luck.choice([-86400, -3, -1, 1, 2, 3600, 10**9])
    for message in _part(luck, luck.choice([imu_samples, clouds])(entries)):
        message.header.stamp.sec = max(min(message.header.stamp.sec + shift, 2**31 - 1), 0)


def messages_lost(luck: random.Random, entries: list[Entry]) -> None:
    topic = luck.choice([IMU_TOPIC, LIDAR_TOPIC])
    first = luck.randrange(len(entries))
    last = first + luck.choice([5, 50, 200, len(entries)])
    entries[first:last] = [entry for entry in entries[first:last] if entry[0] != topic]


def messages_shuffled(luck: random.Random, entries: list[Entry]) -> None:
    first, count = luck.randrange(len(entries)), luck.choice([2, 10, 100])
    part = entries[first : first + count]
    luck.shuffle(part)
    again = luck.choice([part, part + copy.deepcopy(part)])
    entries[first : first + count] = again


def cloud_values(luck: random.Random, entries: list[Entry]) -> None:
    share, value, chosen = luck.choice([0.01, 0.1, 0.5, 1.0]), luck.choice([*HUGE, 30.0]), luck.randrange(6)
    for cloud in _part(luck, clouds(entries)):
        field = cloud.fields[chosen % len(cloud.fields)]
        kind = {7: "<f4", 8: "<f8", 4: "<u2", 2: "u1"}.get(field.datatype, "u1")
        if field.offset + int(kind[-1]) > cloud.point_step:
            continue
        if kind[-2] == "u":
            value = luck.randrange(256)
        if not cloud.fields or cloud.width * cloud.point_step > len(cloud.data):
            continue  # other damage got there first
        data = cloud.data.copy()
        column = np.ndarray((cloud.width,), kind, data.data, field.offset, (cloud.point_step,))
        with np.errstate(over="ignore"):
            column[np.array([luck.random() for _ in range(cloud.width)]) < share] = value
        cloud.data = data


def cloud_shape(luck: random.Random, entries: list[Entry]) -> None:
    name = luck.choice(["height", "width", "point_step", "row_step"])
    value = luck.choice([0, 1, 2, 3, 17, 1000, 2**31, 2**32 - 1])
    for cloud in _part(luck, clouds(entries)):
        setattr(cloud, name, value)


def cloud_data(luck: random.Random, entries: list[Entry]) -> None:
    how = luck.choice(["cut", "empty", "noise", "order"])
    for cloud in _part(luck, clouds(entries)):
        if how == "order":
            cloud.is_bigendian = True
        elif how == "noise":
            cloud.data = np.frombuffer(luck.randbytes(len(cloud.data)), np.uint8)
        else:
            cloud.data = cloud.data[: 0 if how == "empty" else luck.randrange(len(cloud.data) + 1)]


def cloud_fields(luck: random.Random, entries: list[Entry]) -> None:
    chosen, name = luck.randrange(6), luck.choice(["offset", "datatype", "count", "name"])
    value = {"offset": luck.choice([0, 3, 4, 2**31]), "datatype": luck.randrange(12), "count": luck.randrange(3)}
    value |= {"name": luck.choice(["", "x", "time", "\x1b[2J", "ring"])}  # type: ignore[dict-item]
    for cloud in _part(luck, clouds(entries)):
        cloud.fields = copy.deepcopy(cloud.fields)
        if luck.random() < 0.2:
            del cloud.fields[chosen % len(cloud.fields)]
        elif cloud.fields:
            setattr(cloud.fields[chosen % len(cloud.fields)], name, value[name])


MESSAGES: tuple[Callable[[random.Random, list[Entry]], None], ...] = (
    imu_spikes, imu_spikes, imu_scaled, imu_axes, imu_stuck, stamps, messages_lost, messages_shuffled,
    cloud_values, cloud_values, cloud_shape, cloud_data, cloud_fields,
)  # fmt: skip
"""Damage to messages; some kinds appear more often."""


def bytes_damaged(luck: random.Random, data: bytes) -> bytes:
    """Flip bits, or overwrite, remove, repeat, cut off or zero a stretch."""
    made = bytearray(data)
    for _ in range(luck.choice([1, 1, 1, 5, 50])):
        if not made:
            break
        # Mostly near the ends, where formats keep their headers and indexes.
        at = min(luck.choice([luck.randrange(len(made)), int(luck.expovariate(1 / 200))]), len(made) - 1)
        at = luck.choice([at, len(made) - 1 - at])
        length = luck.choice([1, 4, 8, 100, 5000])
        match luck.randrange(7):
            case 0 | 1:
                made[at] ^= 1 << luck.randrange(8)
            case 2:
                made[at : at + length] = luck.randbytes(length)
            case 3:
                made[at : at + 8] = luck.choice([b"\xff" * 8, bytes(8), b"\xff" * 4, (2**31).to_bytes(8, "little")])
            case 4:
                del made[at : at + length]
            case 5:
                made[at:at] = made[at : at + length]
            case 6:
                del made[at:]
    return bytes(made)
