"""IMU datagrams: in order whatever the network does; and the sender in the documentation works.

Tests app/sensors/live/udp.py.
"""

import random
import re
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

from app.sensors.live.imu_udp import ImuOrder, ImuSample, read_imu, write_imu
from app.sensors.live.intake import Intake
from app.sensors.live.status import Counters
from app.sensors.live.udp import ImuReceiver
from app.slam.params import Params
from tests.sensors.live import ports

GUIDE = Path(__file__).resolve().parents[3] / "docs" / "guide" / "live.md"


def sample(number: int) -> ImuSample:
    return ImuSample(number % 2**32, 10**18 + 5_000_000 * number, (0.1, -0.2, 0.3), (1.0, 2.0, 9.0 + number % 7))


def numbers(order: ImuOrder, sent: list[int]) -> list[int]:
    found = [s.number for n in sent for s in order.add(write_imu(sample(n)))]
    return found + [s.number for s in order.flush()]


def test_a_sample_is_sixty_four_bytes_as_documented() -> None:
    raw = struct.pack("<4sIq6d", b"HIMU", 5, sample(5).stamp_ns, 0.1, -0.2, 0.3, 1.0, 2.0, 14.0)
    assert write_imu(sample(5)) == raw and len(raw) == 64
    assert read_imu(raw * 3) == [sample(5)] * 3
    assert read_imu(raw[:-1]) == read_imu(b"X" + raw[1:]) == read_imu(b"") == []


def test_order_is_restored_and_loss_is_counted() -> None:
    assert numbers(ImuOrder(), [0, 2, 1, 3, 6, 5, 4, 7]) == list(range(8))
    order = ImuOrder(Counters())
    assert numbers(order, [10, 11, 13, 14, 15, 16, 17, 18]) == [10, 11, 13, 14, 15, 16, 17, 18]
    assert order.counters.imu_lost == 1
    order = ImuOrder(Counters())
    assert numbers(order, [1, 2, 2, 3, 1, 4]) == [1, 2, 3, 4]
    assert order.counters.imu_late == 2


def test_numbers_wrap_and_senders_begin_again() -> None:
    top = 2**32 - 2
    assert numbers(ImuOrder(), [top, top + 2, top + 1, top + 3]) == [top, top + 1, 0, 1]
    assert numbers(ImuOrder(), [50_000, 50_001, 0, 1, 2]) == [50_000, 50_001, 0, 1, 2]


def test_garbage_is_counted_and_stops_nothing() -> None:
    rng = random.Random(0)
    order = ImuOrder(Counters())
    for _ in range(20_000):
        order.add(rng.randbytes(rng.randrange(200)))
        mixed = bytearray(write_imu(sample(rng.randrange(100))))
        mixed[rng.randrange(64)] = rng.randrange(256)
        order.add(bytes(mixed))
    assert order.counters.imu_foreign > 19_000
    order.flush()
    assert numbers(order, [1_000_000, 1_000_001, 1_000_002]) == [1_000_000, 1_000_001, 1_000_002]


def test_the_documented_sender_is_understood() -> None:
    text = re.search(r"A complete sender:\n\n```python\n(.+?)```", GUIDE.read_text(encoding="utf-8"), re.DOTALL)
    assert text is not None
    (port,) = ports.free(1)
    intake, stop = Intake(Params()), threading.Event()
    receiver = ImuReceiver(intake, "127.0.0.1", port)
    thread = threading.Thread(target=receiver, args=(stop,))
    thread.start()
    script = text[1].replace("6700", str(port))
    sender = subprocess.Popen([sys.executable, "-c", script])
    try:
        deadline = time.monotonic() + 20.0
        while intake.counters.imu < 50 and time.monotonic() < deadline:
            time.sleep(0.02)
    finally:
        sender.kill()
        sender.wait(5.0)
        stop.set()
        thread.join(5.0)
    assert intake.counters.imu >= 50
    assert (intake.counters.imu_lost, intake.counters.imu_foreign) == (0, 0)
