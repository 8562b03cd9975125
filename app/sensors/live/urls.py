"""Addresses of live data, such as `rsbpearl://0.0.0.0:6699,7788?clock=host`, and the source that they stand for."""

import ipaddress
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast
from urllib.parse import parse_qsl, urlsplit

from app.sensors.live.devices import DEVICES
from app.sensors.live.difop import read_angles
from app.sensors.live.imu_udp import IMU_PORT
from app.sensors.live.intake import Clock, Intake, Receive
from app.sensors.live.recorder import Recorder
from app.sensors.live.source import Known, LiveSource
from app.slam.errors import HemislamError
from app.slam.params import Params

FOXGLOVE_PORT = 8765


@dataclass(frozen=True, slots=True)
class _Kind:
    """The parts that an address of one scheme may have."""

    ports: tuple[int, ...]
    options: tuple[str, ...]
    example: str


_KINDS: dict[str, _Kind] = {
    **{
        scheme: _Kind(
            device.ports,
            ("clock", "angles") if device.has_angles else ("clock",),
            f"{scheme}://0.0.0.0:{','.join(map(str, device.ports))}",
        )
        for scheme, device in DEVICES.items()
    },
    "imu-udp": _Kind((IMU_PORT,), (), "imu-udp://:6700"),
    "foxglove": _Kind((FOXGLOVE_PORT,), ("clock",), "foxglove://192.168.1.5:8765"),
}


@dataclass(frozen=True, slots=True)
class Address:
    """Attributes:
    ports: a sensor may have several: for measurements, then for its other packets.
    options: `clock` (auto, sensor, host); of a RoboSense also `angles` (a CSV).
    """

    scheme: str
    host: str
    ports: tuple[int, ...]
    options: dict[str, str] = field(default_factory=dict)


def parse_address(text: str) -> Address:
    """Raises HemislamError: the address is not of a known form."""
    scheme, separator, rest = text.partition("://")
    if not separator or scheme not in _KINDS:
        raise HemislamError(
            f"`{text}` is not a live source; write one of {', '.join(kind.example for kind in _KINDS.values())}."
        )
    kind = _KINDS[scheme]
    try:
        parts = urlsplit(f"//{rest}")
    except ValueError:  # a bracket that is not closed
        raise HemislamError(f"`{text}` has no valid host; write it as {kind.example}.") from None
    host, colon, numbers = parts.netloc.rpartition(":")
    if not colon or numbers.endswith("]"):  # an IPv6 address without a port
        host, numbers = parts.netloc, ""
    try:
        ports = tuple(map(int, numbers.split(","))) if numbers else ()
        ports += kind.ports[len(ports) :]
        if len(ports) != len(kind.ports) or not all(0 <= port < 65_536 for port in ports):
            raise ValueError
    except ValueError:
        raise HemislamError(f"`{text}` has no valid ports; write it as {kind.example}.") from None
    if not _is_host(host := host.strip("[]")):
        raise HemislamError(f"`{text}`: `{host}` cannot be a host; write it as {kind.example}.")
    options = dict(parse_qsl(parts.query))
    if unknown := [name for name in options if name not in kind.options]:
        known = ", ".join(kind.options) or "none"
        raise HemislamError(f"`{text}`: there is no option `{unknown[0]}`; the options are: {known}.")
    if options.get("clock", "auto") not in ("auto", "sensor", "host"):
        raise HemislamError(f"`{text}`: the clock is `auto`, `sensor` or `host`.")
    return Address(scheme, host, ports, options)


def _is_host(host: str) -> bool:
    """Whether a text may be a host's name or address, or is empty; not whether the host exists."""
    try:
        if ":" in host:
            ipaddress.IPv6Address(host)
            return True
        host.encode("idna")
    except ValueError:
        return False
    return not any(character.isspace() or character in "@[]\0" for character in host)


def open_live(
    lidar: str, params: Params, imu: str | None = None, record: Path | None = None, before: Known | None = None
) -> LiveSource:
    """Begin to receive.

    Args:
        lidar: a sensor's address, such as `rsbpearl://HOST:MSOP,DIFOP`, or `foxglove://HOST:PORT`.
        imu: `imu-udp://HOST:PORT`, or another `foxglove://`; None: from the LiDAR's source.
        record: an .mcap into which everything is written.
        before: the state of a source that this one replaces.

    Raises:
        HemislamError: an address has no known form, a port cannot be opened, or a file not be written.
    """
    from app.sensors.live.foxglove import FoxgloveReceiver
    from app.sensors.live.udp import ImuReceiver, PacketReceiver

    address = parse_address(lidar)
    beside = parse_address(imu) if imu else None
    device = DEVICES.get(address.scheme)
    if address.scheme == "imu-udp":
        raise HemislamError(f"`{lidar}` gives no point clouds; use {', '.join(DEVICES)} or foxglove:// for them.")
    if beside is not None and beside.scheme in DEVICES:
        raise HemislamError(f"`{imu}` is not an IMU address; write --imu imu-udp://:6700 or foxglove://HOST:8765.")
    if beside is None and device is not None and not device.has_imu:
        raise HemislamError(
            "An RS-Bpearl's packets hold no IMU samples; say where those come from, e.g. --imu imu-udp://:6700."
        )
    angles = read_angles(Path(address.options["angles"])) if "angles" in address.options else None
    clock = cast(Clock, address.options.get("clock", "auto"))
    intake = Intake(params, clock, *((before.state.counters, before.settled) if before else ()))
    receivers: list[Receive] = []
    if beside is not None and beside.scheme == "imu-udp":
        receivers.append(ImuReceiver(intake, beside.host or "0.0.0.0", beside.ports[0]))
    if device is not None:
        receivers.append(
            PacketReceiver(intake, device, address.host or "0.0.0.0", address.ports, angles, own_imu=beside is None)
        )
    # One connection to each Foxglove server, for all topics wanted from it.
    wanted: dict[tuple[str, int], frozenset[str]] = {}
    for source, sensors in ((address, {"lidar"} if beside else {"lidar", "imu"}), (beside, {"imu"})):
        if source is not None and source.scheme == "foxglove":
            at = (source.host or "127.0.0.1", source.ports[0])
            wanted[at] = wanted.get(at, frozenset()) | sensors
    receivers += [FoxgloveReceiver(intake, *at, sensors) for at, sensors in wanted.items()]
    intake.recorder = Recorder(record) if record else None
    return LiveSource(receivers, intake, before)
