"""Time to put the sensor's packets in order and to decode a revolution."""

import time

import numpy as np

from app.sensors.live.decoder import Decoder
from app.sensors.live.difop import ChannelAngles, Difop
from app.sensors.live.frames import Assembler, Revolution
from app.sensors.live.msop import Firings, PacketWriter
from app.sensors.robosense import AIRY, BPEARL, BPV4, Model
from app.slam.types import Scan
from benchmarks.record import Line

TURNS = 300


def run() -> list[Line]:
    return [line for model in (BPEARL, BPV4, AIRY) for line in measure(model)]


def measure(model: Model) -> list[Line]:
    """Times (ms) to put the packets of a revolution in order and to decode it, if every firing has a return."""
    assembler, decoder = Assembler(), Decoder(model=model)
    decoder.configure(Difop(calibration=ChannelAngles(model.elevations_deg, np.linspace(-1.0, 0.0, model.channels))))
    assembling: list[float] = []
    decoding: list[float] = []
    points = 0
    frames: list[Revolution] = []
    for turn, packets in enumerate(_turns(model)):
        begin = time.perf_counter()
        for packet in packets:
            frames += assembler.add(packet, 0)
        assembling.append((time.perf_counter() - begin) * 1e3)
        for frame in frames:
            begin = time.perf_counter()
            scan = decoder.decode(frame)
            if turn > 10:
                decoding.append((time.perf_counter() - begin) * 1e3)
            points = len(scan) if isinstance(scan, Scan) else 0
        frames.clear()
    on = f"{model.name}: {points:,} firings a revolution"
    return [Line.of("packets in order", on, "ms", assembling), Line.of("packets decoded", on, "ms", decoding)]


def _turns(model: Model) -> list[list[bytes]]:
    blocks = 100_000_000 // model.block_ns
    writer = PacketWriter(model)
    rng = np.random.default_rng(0)
    azimuth = np.rint(np.arange(blocks) * 36_000 / blocks).astype(np.uint16)
    counts = rng.integers(100, 10_000, (blocks, model.channels)).astype(np.uint16)
    intensity = rng.integers(0, 256, (blocks, model.channels)).astype(np.uint8)
    start = 1_700_000_000_000_000_000
    turns = []
    for turn in range(TURNS):
        times = start + (turn * blocks + np.arange(blocks, dtype=np.int64)) * model.block_ns
        turns.append([packet for _, packet in writer.add(Firings(times, azimuth, counts, intensity))])
    return turns
