"""Where live data come from and go to, as one writes it: `rsbpearl://0.0.0.0:6699,7788?clock=host`."""

import ipaddress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, cast
from urllib.parse import parse_qsl, urlsplit

from app.sensors.live.difop import DIFOP_PORT, read_angles
from app.sensors.live.imu_udp import IMU_PORT
from app.sensors.live.intake import Clock, Intake, Receive
from app.sensors.live.msop import MSOP_PORT
from app.sensors.live.recorder import Recorder
from app.sensors.live.source import Known, LiveSource
from app.slam.errors import HemislamError
from app.slam.params import Params

Scheme = Literal["rsbpearl", "imu-udp", "foxglove"]
FOXGLOVE_PORT = 8765
_DEFAULT_PORTS: dict[str, tuple[int, ...]] = {
    "rsbpearl": (MSOP_PORT, DIFOP_PORT),
    "imu-udp": (IMU_PORT,),
    "foxglove": (FOXGLOVE_PORT,),
}
_OPTIONS: dict[str, tuple[str, ...]] = {"rsbpearl": ("clock", "angles"), "imu-udp": (), "foxglove": ("clock",)}
_EXAMPLES = {
    "rsbpearl": "rsbpearl://0.0.0.0:6699,7788",
    "imu-udp": "imu-udp://:6700",
    "foxglove": "foxglove://192.168.1.5:8765",
}


@dataclass(frozen=True, slots=True)
class Address:
    """Attributes:
    ports: of `rsbpearl` two, for measurements and for the device's own packets.
    options: rsbpearl: `clock` (auto, sensor, host), `angles` (a CSV); foxglove: `clock`.
    """

    scheme: Scheme
    host: str
    ports: tuple[int, ...]
    options: dict[str, str] = field(default_factory=dict)


def parse_address(text: str) -> Address:
    """Raises HemislamError: it is none of the kinds there are."""
    scheme, separator, rest = text.partition("://")
    if not separator or scheme not in _DEFAULT_PORTS:
        raise HemislamError(f"`{text}` is no live source; write one of {', '.join(_EXAMPLES.values())}.")
    try:
        parts = urlsplit(f"//{rest}")
    except ValueError:  # a bracket that is not closed
        raise HemislamError(f"`{text}` has no host as it must be; write it as {_EXAMPLES[scheme]}.") from None
    host, colon, numbers = parts.netloc.rpartition(":")
    if not colon:
        host, numbers = parts.netloc, ""
    defaults = _DEFAULT_PORTS[scheme]
    try:
        ports = tuple(int(number) for number in numbers.split(",")) if numbers else defaults
        ports += defaults[len(ports) :]
        if len(ports) != len(defaults) or not all(0 <= port < 65_536 for port in ports):
            raise ValueError
    except ValueError:
        raise HemislamError(f"`{text}` has no ports as they must be; write it as {_EXAMPLES[scheme]}.") from None
    if not _is_host(host := host.strip("[]")):
        raise HemislamError(f"`{text}`: `{host}` can be no host; write it as {_EXAMPLES[scheme]}.")
    options = dict(parse_qsl(parts.query))
    if unknown := [name for name in options if name not in _OPTIONS[scheme]]:
        known = ", ".join(_OPTIONS[scheme]) or "none"
        raise HemislamError(f"`{text}`: there is no option `{unknown[0]}`; there are: {known}.")
    if options.get("clock", "auto") not in ("auto", "sensor", "host"):
        raise HemislamError(f"`{text}`: the clock is `auto`, `sensor` or `host`.")
    return Address(cast(Scheme, scheme), host, ports, options)


def _is_host(host: str) -> bool:
    """Whether it is a name or an address, or nothing: whether it exists is another question."""
    if ":" in host:
        try:
            ipaddress.IPv6Address(host)
        except ValueError:
            return False
        return True
    try:
        host.encode("idna")
    except UnicodeError:
        return False
    return not any(character.isspace() or character in "@[]\0" for character in host)


def open_live(
    lidar: str, params: Params, imu: str | None = None, record: Path | None = None, before: Known | None = None
) -> LiveSource:
    """Begin to receive.

    Args:
        lidar: `rsbpearl://HOST:MSOP,DIFOP` or `foxglove://HOST:PORT`. imu: `imu-udp://HOST:PORT`, or another
            `foxglove://`; None: from the LiDAR's Foxglove source.
        record: an .mcap to write all of it into.
        before: what a source that this one takes the place of had found out.

    Raises:
        HemislamError: an address cannot be understood, a port not opened, a file not written.
    """
    address = parse_address(lidar)
    beside = parse_address(imu) if imu else None
    if address.scheme == "imu-udp" or (beside is not None and beside.scheme == "rsbpearl"):
        raise HemislamError(f"`{lidar}` gives no point clouds; use rsbpearl:// or foxglove:// for them.")
    if beside is None and address.scheme == "rsbpearl":
        raise HemislamError(
            "An RS-Bpearl's packets hold no IMU samples; say where those come from, e.g. --imu imu-udp://:6700."
        )
    angles = read_angles(Path(address.options["angles"])) if "angles" in address.options else None
    receivers: list[Receive] = []
    if beside is not None and beside.scheme == "imu-udp":
        from app.sensors.live.udp import ImuReceiver

        receivers.append(ImuReceiver(beside.host or "0.0.0.0", beside.ports[0]))
    if address.scheme == "rsbpearl":
        from app.sensors.live.udp import RsbpearlReceiver

        receivers.append(RsbpearlReceiver(address.host or "0.0.0.0", address.ports[0], address.ports[1], angles))
    for foxglove, wanted in _foxglove(address, beside):
        from app.sensors.live.foxglove import FoxgloveReceiver

        receivers.append(FoxgloveReceiver(foxglove.host or "127.0.0.1", foxglove.ports[0], wanted, params))
    recorder = Recorder(record) if record else None
    clock = cast(Clock, address.options.get("clock", "auto"))
    known = (before.counters, before.settled) if before else ()
    return LiveSource(receivers, Intake(params, clock, recorder, *known), params, recorder, before)


def _foxglove(address: Address, beside: Address | None) -> list[tuple[Address, frozenset[str]]]:
    """The Foxglove connections there are to be, and what is wanted of each."""
    wanted: dict[tuple[str, tuple[int, ...]], tuple[Address, frozenset[str]]] = {}
    for source, kinds in ((address, {"lidar"} if beside else {"lidar", "imu"}), (beside, {"imu"})):
        if source is not None and source.scheme == "foxglove":
            _, known = wanted.get((source.host, source.ports), (source, frozenset()))
            wanted[source.host, source.ports] = (source, known | kinds)
    return list(wanted.values())
