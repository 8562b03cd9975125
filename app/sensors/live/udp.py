"""Receiving threads for UDP: packets of LiDARs, and IMU samples."""

import contextlib
import select
import socket
import struct
import sys
import threading
import time
from collections import deque

from app.sensors.cloud_types import CLOUD_TYPES
from app.sensors.live.cloud_reader import CloudReader
from app.sensors.live.decoder import Decoder
from app.sensors.live.devices import Device, mount_finding
from app.sensors.live.difop import DIFOP_ID, ChannelAngles, Difop, read_difop
from app.sensors.live.frames import Assembler, Revolution, sensor_of
from app.sensors.live.imu_udp import ImuOrder, ImuSample, is_imu
from app.sensors.live.intake import Intake
from app.sensors.live.livox_udp import read_points
from app.sensors.live.msop import other_sensor
from app.sensors.robosense import Model
from app.slam.errors import HemislamError
from app.slam.types import Scan

BUFFER_BYTES = 16 << 20
"""Buffer size requested from the kernel, so that no packet is lost while this process is busy; it may grant less."""
_DRAIN = 128
_TIMESTAMP = 35
"""SO_TIMESTAMPNS: Linux notes when a datagram arrived, so that the time of reading matters little."""
_TIMESPEC = struct.Struct("@ll")
_REST_NS = 1_000_000_000
"""Packets wait this long for the rest of their revolution. This only concerns the last packets before a silence."""
_DEVICE_WAIT_NS = 1_500_000_000
"""The device sends its angles once a second; at the start, scans wait for them."""


def open_socket(host: str, port: int) -> socket.socket:
    """A bound UDP socket.

    Raises:
        HemislamError: the port is taken, or the address is not this machine's.
    """
    made = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
    try:
        made.bind((host, port))
    except OSError as error:
        made.close()
        raise HemislamError(
            f"UDP port {port} on {host or 'all addresses'} cannot be opened ({error.strerror}); "
            "is another program receiving there?"
        ) from None
    force = getattr(socket, "SO_RCVBUFFORCE", 33)
    try:
        made.setsockopt(socket.SOL_SOCKET, force, BUFFER_BYTES)
    except OSError:  # only root may go beyond the system's limit
        with contextlib.suppress(OSError):
            made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            made.setsockopt(socket.SOL_SOCKET, _TIMESTAMP, 1)
    made.setblocking(False)
    return made


Peer = tuple[str, int]
"""Address and port of a sender."""


def _drain(ready: socket.socket) -> list[tuple[bytes, int, Peer]]:
    """Some of the waiting datagrams, each with its arrival by the host's clock and its sender."""
    found: list[tuple[bytes, int, Peer]] = []
    while len(found) < _DRAIN:
        try:
            data, extra, _, peer = ready.recvmsg(65_536, 64)
        except (BlockingIOError, ConnectionError):
            break
        arrival_ns = time.time_ns()
        for level, kind, value in extra:
            if level == socket.SOL_SOCKET and kind == _TIMESTAMP and len(value) == _TIMESPEC.size:
                seconds, nanoseconds = _TIMESPEC.unpack(value)
                arrival_ns = seconds * 1_000_000_000 + nanoseconds
        found.append((data, arrival_ns, (str(peer[0]), int(peer[1]))))
    return found


class PacketReceiver:
    """Receives a sensor's own packets. Its sockets are open from the start, so that nothing is missed.

    Args:
        own_imu: whether to take IMU samples from it, too.

    Raises:
        HemislamError: a port cannot be opened, or the angles are those of another sensor.
    """

    def __init__(
        self,
        intake: Intake,
        device: Device,
        host: str,
        ports: tuple[int, ...],
        angles: ChannelAngles | None = None,
        own_imu: bool = False,
    ) -> None:
        self._intake, model = intake, device.model
        self._decoder = Decoder(angles, model) if isinstance(model, Model) else None
        self._clouds = CloudReader(intake, device.layout.lidar_topic, CLOUD_TYPES[device.layout.kind])
        with contextlib.ExitStack() as opened:  # closes those before a port that cannot be opened
            self._sockets = [opened.enter_context(open_socket(host, port)) for port in dict.fromkeys(ports)]
            self._opened = opened.pop_all()
        if self._decoder is not None:
            self._decoder.warm_up()
            self._decoder.counters = intake.counters
        self._model = model
        self._own_imu = own_imu and device.has_imu
        self._assembler, self._order = Assembler(intake.counters, device.models), ImuOrder(intake.counters)
        self._wait_until_ns: int | None = None
        self._device: Difop | None = None
        self._frames: deque[Revolution] = deque()
        self._angles_settled = angles is not None or not device.has_angles
        self._sensor: Peer | None = None
        self._heard_s = 0.0

    def __call__(self, stop: threading.Event) -> None:
        with self._opened:
            while not stop.is_set():
                ready, _, _ = select.select(self._sockets, [], [], 0.05)
                now = time.time_ns()
                for readable in ready:
                    for packet, arrival_ns, peer in _drain(readable):
                        self._take(packet, arrival_ns, peer)
                if not ready:
                    self._put_imu(self._order.flush(), now)
                since = self._assembler.pending_since()
                if self._sockets[0] not in ready and since is not None and now - since > _REST_NS:
                    self._frames += self._assembler.flush()
                self._give(now)

    def _take(self, packet: bytes, now: int, peer: Peer) -> None:
        sensor, is_difop, of_imu = sensor_of(packet), packet[:8] == DIFOP_ID, is_imu(packet)
        if (is_difop or of_imu or sensor is not None) and self._is_another(peer, is_difop or of_imu):
            self._intake.counters.foreign += 1
        elif of_imu:
            if self._own_imu:
                self._put_imu(self._order.add(packet), now)
        elif is_difop and isinstance(self._model, Model):
            difop = read_difop(packet, self._model)
            if difop is None:
                self._intake.counters.truncated += 1
            else:
                self._intake.counters.difop += 1
                self._configure(difop, now)
        else:
            self._frames += self._assembler.add(packet, now)
            if sensor is None and (other := other_sensor(packet)):
                text = f"{peer[0]} is {other}, whose packets are not read; take its clouds from ROS, by foxglove://"
                self._intake.put_status("configuration", text, once=True)

    def _put_imu(self, samples: list[ImuSample], arrival_ns: int) -> None:
        for sample in samples:
            self._intake.put_imu(sample.stamp_ns, sample.gyro, sample.accel, arrival_ns)

    def _is_another(self, peer: Peer, beside: bool) -> bool:
        """Whether a packet is from another sensor than the one in use, which is the first until it falls silent.

        Args:
            beside: whether the packet holds settings or IMU samples, which a sensor sends from another port.
        """
        current, now = self._sensor, time.monotonic()
        if current is None or now - self._heard_s > _REST_NS * 1e-9:
            current = None if beside else peer
        elif (peer[0] != current[0]) if beside else (peer != current):
            text = f"{peer[0]} sends to the port of {current[0]} too; its packets are left out while both send"
            self._intake.put_status("configuration", text, once=True)
            return True
        if not beside:
            self._sensor, self._heard_s = current, now
        return False

    def _configure(self, difop: Difop, now: int) -> None:
        before, self._device = self._device, difop
        if self._decoder is None or (before is not None and before.same(difop)):
            return
        if before is not None:
            self._give(now)  # earlier packets were measured with the old settings
        self._decoder.configure(difop)
        self._assembler.turn_ns = round(60e9 / difop.rpm)
        self._intake.sensor = f"{self._model.name} {difop.serial}: {difop.describe()}"
        if before is not None:
            self._intake.put_status("configuration", f"the LiDAR was set to {difop.describe()}")
            return
        self._intake.put_status("connected", self._intake.sensor)
        if difop.T_imu_lidar is not None:
            self._intake.put_status("configuration", mount_finding(difop.T_imu_lidar).text)

    def _give(self, now: int) -> None:
        """Decode and hand on; at the start, once the angles are known or their time is up."""
        if not self._frames:
            return
        if self._device is None and not self._angles_settled:
            self._wait_until_ns = self._wait_until_ns or now + _DEVICE_WAIT_NS
            if now < self._wait_until_ns:
                return
            self._angles_settled = True
            text = "no DIFOP packet came with this unit's angles; the nominal ones are used until one comes"
            self._intake.put_status("configuration", text)
        while self._frames:
            frame = self._frames.popleft()
            if self._decoder is not None:
                ready = [(self._decoder.decode(frame), frame.arrival_ns)]
            else:
                ready = self._clouds.add(read_points(frame.packets), int(frame.stamps_ns[0]), frame.arrival_ns)
            for scan, arrival_ns in ready:
                self._intake.put_scan(scan, arrival_ns)
                if isinstance(scan, Scan) and not self._intake.sensor:
                    without = "" if self._decoder is None else ", without device packets"
                    self._intake.sensor = f"{frame.model.name}{without}"


class ImuReceiver:
    """Receives IMU samples (see `imu_udp.py`). Raises HemislamError: the port cannot be opened."""

    def __init__(self, intake: Intake, host: str, port: int) -> None:
        self._intake = intake
        self._socket = open_socket(host, port)
        self._order = ImuOrder(intake.counters)

    def __call__(self, stop: threading.Event) -> None:
        with self._socket:
            while not stop.is_set():
                ready, _, _ = select.select([self._socket], [], [], 0.05)
                samples = [(s, at) for datagram, at, _ in _drain(self._socket) for s in self._order.add(datagram)]
                samples = samples or [(s, time.time_ns()) for s in ([] if ready else self._order.flush())]
                for sample, arrival_ns in samples:
                    self._intake.put_imu(sample.stamp_ns, sample.gyro, sample.accel, arrival_ns)
