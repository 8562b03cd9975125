"""A revolution of packets as a `Scan`."""

import numpy as np

from app.sensors.live.difop import ChannelAngles, Difop
from app.sensors.live.frames import Revolution
from app.sensors.live.kernels import decode_blocks
from app.sensors.live.msop import HEADER_BYTES, PACKET_BYTES, TURN
from app.sensors.live.status import Counters
from app.sensors.robosense import BPEARL, Model
from app.slam.errors import HemislamError
from app.slam.types import F64, U16, DroppedScan, Scan

MIN_RANGE_M, MAX_RANGE_M = 0.1, 150.0
"""m: a distance outside these is not a return."""


class Decoder:
    """Decodes revolutions of one sensor.

    Attributes:
        calibration: the one in use: from a file, else the device's own, else the nominal one.
        difop: the device's settings. counters: count the blocks without their mark or azimuth.
    """

    def __init__(self, angles: ChannelAngles | None = None, model: Model = BPEARL) -> None:
        """Raises HemislamError: the angles are those of another sensor."""
        if angles is not None and len(angles.elevations_deg) != model.channels:
            raise HemislamError(
                f"These are angles of {len(angles.elevations_deg)} channels, but an {model.name} has {model.channels}; "
                "use this unit's own."
            )
        self._angles, self._model = angles, model
        self.counters = Counters()
        self.configure(Difop())

    def configure(self, difop: Difop) -> None:
        """Use these settings from now on."""
        self.difop = difop
        self.calibration = self._angles or difop.calibration or ChannelAngles.nominal(self._model)
        elevation = np.radians(self.calibration.elevations_deg)
        horizontal = np.radians(self.calibration.horizontal_deg)
        angles = (np.cos(elevation), np.sin(elevation), np.cos(horizontal), np.sin(horizontal))
        self._trigonometry: tuple[F64, F64, F64, F64] = angles
        self._rings: U16 = self.calibration.rings

    def warm_up(self) -> None:
        """Compile or load the kernel before the first packet arrives."""
        packets = np.zeros((1, PACKET_BYTES), np.uint8)
        packets.setflags(write=False)
        self.decode(Revolution(self._model, packets, np.zeros(1, np.int64), 0, self._model.blocks, 0))
        self.counters = Counters()

    def decode(self, frame: Revolution) -> Scan | DroppedScan:
        """The scan in firing order: block by block, in each by channel."""
        model = frame.model
        assert isinstance(model, Model)
        if model.channels != self._model.channels:
            return DroppedScan(int(frame.stamps_ns[0]), f"it is of another sensor ({model.name})")
        room = len(frame.packets) * model.blocks * model.channels
        points, times = np.empty((room, 3), np.float32), np.empty(room, np.int64)
        intensity, ring = np.empty(room, np.float32), np.empty(room, np.uint16)
        base_ns = int(frame.stamps_ns[0])
        n, bad = decode_blocks(
            frame.packets, frame.stamps_ns - base_ns, frame.first, frame.stop, self.difop.reverse,
            self._step(frame, model), 60e9 / self.difop.rpm, *self._trigonometry,
            model.firing_offsets_ns / model.block_ns, model.firing_offsets_ns, self._rings,
            model.blocks, model.parts, model.part, model.counted, model.block_ns, model.range_step,
            round(MIN_RANGE_M / model.range_step), round(MAX_RANGE_M / model.range_step), model.rx, model.rz,
            points, times, intensity, ring,
        )  # fmt: skip
        self.counters.bad_blocks += bad
        if not n:
            return DroppedScan(base_ns, "none of its firings returned")
        times = times[:n]
        earliest = int(times.min())
        if int(times.max()) - earliest > np.iinfo(np.int32).max:
            return DroppedScan(base_ns, "its points are more than 2 s apart, too long for one scan")
        offsets_ns = (times - earliest).astype(np.int32)
        return Scan(base_ns + earliest, points[:n].copy(), offsets_ns, intensity[:n].copy(), ring[:n].copy())

    def _step(self, frame: Revolution, model: Model) -> float:
        """Azimuth from block to block, 0.01 deg: the median, or computed from the stated speed."""
        at = HEADER_BYTES + 2 + model.parts * model.part_bytes * np.arange(model.blocks)
        azimuth = (frame.packets[:, at].astype(np.int64) << 8) | frame.packets[:, at + 1]
        step = (np.diff(azimuth, axis=1) + TURN // 2) % TURN - TURN // 2
        step = step[(step != 0) & (np.abs(step) <= 100)]
        return float(np.median(step)) if step.size else TURN * self.difop.rpm / 60.0 * model.block_ns * 1e-9
