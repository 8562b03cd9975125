"""A revolution of packets as a `Scan`."""

import numpy as np

from app.sensors.live.difop import NOMINAL, Calibration, Difop
from app.sensors.live.frames import Frame
from app.sensors.live.kernels import decode_blocks
from app.sensors.live.msop import BLOCK_BYTES, BLOCKS, HEADER_BYTES, PACKET_BYTES, TURN
from app.sensors.rsbpearl import BPEARL, CHANNELS
from app.slam.types import F64, U16, DroppedScan, Scan

MIN_RANGE_M, MAX_RANGE_M = 0.1, 150.0
"""A packet's distance outside is no return."""


class Decoder:
    """Decodes revolutions of one sensor, on arrays that it keeps.

    Attributes:
        calibration: in force; a file's wins over the device's own, that over the nominal one.
        difop: what the device last said about itself. bad_blocks: without their mark or azimuth.
    """

    def __init__(self, angles: Calibration | None = None) -> None:
        self._angles = angles
        self.difop = Difop()
        self.calibration = NOMINAL
        self.bad_blocks = 0
        self._points, self._times = np.empty((0, 3), np.float32), np.empty(0, np.int64)
        self._intensity, self._ring = np.empty(0, np.float32), np.empty(0, np.uint16)
        self.configure(self.difop)

    def configure(self, difop: Difop) -> None:
        self.difop = difop
        self.calibration = self._angles or difop.calibration or NOMINAL
        elevation = np.radians(self.calibration.elevations_deg)
        horizontal = np.radians(self.calibration.horizontal_deg)
        self._trigonometry: tuple[F64, F64, F64, F64] = (
            np.cos(elevation),
            np.sin(elevation),
            np.cos(horizontal),
            np.sin(horizontal),
        )
        self._rings: U16 = self.calibration.rings

    def warm_up(self) -> None:
        """Compile the kernel, or load it, before there is something to decode."""
        packets = np.zeros((1, PACKET_BYTES), np.uint8)
        packets.setflags(write=False)
        self.decode(Frame(BPEARL, packets, np.zeros(1, np.int64), 0, BLOCKS, 0))
        self.bad_blocks = 0

    def decode(self, frame: Frame) -> Scan | DroppedScan:
        """The scan in firing order: block by block, in each by channel."""
        model = frame.model
        room = len(frame.packets) * BLOCKS * CHANNELS
        if room > len(self._times):
            self._points, self._times = np.empty((room, 3), np.float32), np.empty(room, np.int64)
            self._intensity, self._ring = np.empty(room, np.float32), np.empty(room, np.uint16)
        base_ns = int(frame.stamps_ns[0])
        nominal = self._step(frame)
        n, bad = decode_blocks(
            frame.packets, frame.stamps_ns - base_ns, frame.first, frame.stop, self.difop.reverse, nominal,
            60e9 / self.difop.rpm, *self._trigonometry, model.firing_offsets_ns / model.block_ns,
            model.firing_offsets_ns, self._rings, model.block_ns, model.range_step,
            round(MIN_RANGE_M / model.range_step), round(MAX_RANGE_M / model.range_step), model.rx, model.rz,
            self._points, self._times, self._intensity, self._ring,
        )  # fmt: skip
        self.bad_blocks += bad
        if not n:
            return DroppedScan(base_ns, "none of its firings returned")
        times = self._times[:n]
        earliest = int(times.min())
        if int(times.max()) - earliest > np.iinfo(np.int32).max:
            return DroppedScan(base_ns, "its points are more than 2 s apart, which is no single scan")
        scan = Scan(
            base_ns + earliest,
            self._points[:n].copy(),
            (times - earliest).astype(np.int32),
            self._intensity[:n].copy(),
            self._ring[:n].copy(),
        )
        for array in (scan.points, scan.offsets_ns, scan.intensity, scan.ring):
            array.setflags(write=False)
        return scan

    def _step(self, frame: Frame) -> float:
        """0.01 deg from block to block, as most blocks have it; failing that, by the speed the device states."""
        at = HEADER_BYTES + 2 + BLOCK_BYTES * np.arange(BLOCKS)
        azimuth = (frame.packets[:, at].astype(np.int64) << 8) | frame.packets[:, at + 1]
        step = (np.diff(azimuth, axis=1) + TURN // 2) % TURN - TURN // 2
        step = step[(step != 0) & (np.abs(step) <= 100)]
        return float(np.median(step)) if step.size else TURN * self.difop.rpm / 60.0 * frame.model.block_ns * 1e-9
