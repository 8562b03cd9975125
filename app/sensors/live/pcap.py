"""UDP datagrams from .pcap and .pcapng files, with VLAN tags, fragmented IP and IPv6. Other packets are ignored.

The known libraries do not give positions in the file, which are needed to read from a later moment on.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BufferedReader
from pathlib import Path

from app.sensors.log_times import LATEST_NS

CLASSIC_MAGIC = (b"\xd4\xc3\xb2\xa1", b"\xa1\xb2\xc3\xd4", b"\x4d\x3c\xb2\xa1", b"\xa1\xb2\x3c\x4d")
NEXT_MAGIC = b"\x0a\x0d\x0d\x0a"
MAX_RECORD = 1 << 22
_MOST_INTERFACES = 1024
"""Most interfaces of a section; packets of further interfaces are ignored."""
_FRAGMENTS_KEPT = 64
"""Most datagrams that wait for missing fragments; beyond that, the oldest is dropped."""

_TAGS = (0x8100, 0x88A8, 0x9100)
_IP = (b"\x08\x00", b"\x86\xdd")
_UDP, _FRAGMENT = 17, 44


class CaptureError(ValueError):
    """The file is not a capture, or is damaged; the text says how."""


@dataclass(frozen=True, slots=True)
class _Interface:
    """Type of network, time units in a second, ns to add."""

    link: int
    units: int
    offset_ns: int = 0


@dataclass(frozen=True, slots=True)
class CapturePlace:
    """Where a captured frame begins in the file; byte order and interfaces there, by the headers before it."""

    position: int
    order: str = "<"
    interfaces: tuple[_Interface, ...] = ()


@dataclass(frozen=True, slots=True)
class Datagram:
    """One UDP datagram. place: of the captured frame that completes it. sender: IP address, as in the packet."""

    place: CapturePlace
    time_ns: int
    payload: bytes
    sender: bytes


Captured = tuple[CapturePlace, int, int, bytes]
"""A captured frame: place in the file, time ns, type of network, bytes."""


class Capture:
    """A capture file. Reading can begin at the place of any frame of an earlier reading.

    Attributes:
        complete: False once the end was found to be in the middle of a frame.
        shortened: True once a frame was found of which only the beginning was captured.
    """

    def __init__(self, path: Path) -> None:
        """Raises CaptureError: not a capture."""
        self._path = path
        self.complete, self.shortened = True, False
        with path.open("rb") as file:
            start = file.read(24)
        self._frames, self._start = self._next_frames, CapturePlace(0)
        if start[:4] != NEXT_MAGIC:
            if start[:4] not in CLASSIC_MAGIC or len(start) < 24:
                raise CaptureError("it does not begin like a capture")
            order = "<" if start[:4] in (CLASSIC_MAGIC[0], CLASSIC_MAGIC[2]) else ">"
            units = 1_000_000_000 if start[:4] in CLASSIC_MAGIC[2:] else 1_000_000
            link = int(struct.unpack_from(order + "I", start, 20)[0]) & 0xFFFF
            self._frames, self._start = self._classic_frames, CapturePlace(24, order, (_Interface(link, units),))

    def datagrams(self, place: CapturePlace | None = None) -> Iterator[Datagram]:
        """UDP datagrams from a frame's place on, or all; up to the end, or to where the file is damaged."""
        waiting: dict[bytes, _Fragments] = {}
        place = place or self._start
        with self._path.open("rb") as file:
            file.seek(place.position)
            try:
                for at, time_ns, link, frame in self._frames(file, place):
                    packet = _ip_packet(link, frame)
                    if packet and 0 <= time_ns < LATEST_NS:
                        payload = _udp_payload(packet, waiting)
                        if payload is not None:
                            sender = packet[12:16] if packet[0] >> 4 == 4 else packet[8:24]
                            yield Datagram(at, time_ns, payload, sender)
            except EOFError:
                self.complete = False

    def _classic_frames(self, file: BufferedReader, place: CapturePlace) -> Iterator[Captured]:
        """Raises EOFError where the file is damaged or ends within a frame. So does `_next_frames`."""
        (interface,) = place.interfaces
        while file.peek(1):
            position = file.tell()
            seconds, fraction, length, original = struct.unpack(place.order + "4I", _taken(file, 16))
            self.shortened |= length < original
            data = _taken(file, length)
            time_ns = seconds * 1_000_000_000 + fraction * 1_000_000_000 // interface.units
            yield CapturePlace(position, place.order, place.interfaces), time_ns, interface.link, data

    def _next_frames(self, file: BufferedReader, place: CapturePlace) -> Iterator[Captured]:
        order, interfaces = place.order, place.interfaces
        while file.peek(1):
            position = file.tell()
            raw = _taken(file, 8)
            if raw[:4] == NEXT_MAGIC:  # a section begins, perhaps in another byte order
                order, interfaces = "<" if file.read(4) == b"\x4d\x3c\x2b\x1a" else ">", ()
                file.seek(position + 8)
            kind, length = struct.unpack(order + "2I", raw)
            if length < 12 or length % 4:
                raise EOFError
            body = _taken(file, length - 8)
            if kind == 1 and len(body) >= 12 and len(interfaces) < _MOST_INTERFACES:
                interfaces = (*interfaces, _interface(body, order))
            elif kind == 6 and len(body) >= 24:
                number, high, low, captured, original = struct.unpack_from(order + "5I", body)
                self.shortened |= captured < original
                if number < len(interfaces):
                    interface = interfaces[number]
                    time_ns = (high << 32 | low) * 1_000_000_000 // interface.units + interface.offset_ns
                    yield CapturePlace(position, order, interfaces), time_ns, interface.link, body[20 : 20 + captured]


def _taken(file: BufferedReader, size: int) -> bytes:
    """The next bytes. Raises EOFError: there are fewer, or `size` is too large for any record."""
    if size > MAX_RECORD or len(data := file.read(size)) < size:
        raise EOFError
    return data


def _interface(body: bytes, order: str) -> _Interface:
    link = int(struct.unpack_from(order + "H", body)[0])
    units, offset_s, at = 1_000_000, 0, 8
    while at + 4 <= len(body) - 4:
        code, length = struct.unpack_from(order + "2H", body, at)
        value = body[at + 4 : at + 4 + length]
        if code == 0:
            break
        if code == 9 and value:  # if_tsresol
            units = 2 ** (value[0] & 0x7F) if value[0] & 0x80 else 10 ** min(value[0], 18)
        elif code == 14 and len(value) == 8:  # if_tsoffset
            offset_s = int(struct.unpack(order + "q", value)[0])
        at += 4 + (length + 3) // 4 * 4
    return _Interface(link, units, offset_s * 1_000_000_000)


def _ip_packet(link: int, frame: bytes) -> bytes:
    """The IP packet of a captured frame; empty if it holds none."""
    match link:
        case 1:  # Ethernet
            at = 12
        case 113:  # Linux, captured on "any"
            at = 14
        case 276:  # the same, second version
            return frame[20:] if frame[:2] in _IP else b""
        case 0 | 108:  # BSD loopback
            return frame[4:]
        case 12 | 14 | 101 | 228 | 229:  # bare IP
            return frame
        case _:
            return b""
    while int.from_bytes(frame[at : at + 2], "big") in _TAGS:
        at += 4
    return frame[at + 2 :] if frame[at : at + 2] in _IP else b""


@dataclass(slots=True)
class _Fragments:
    """Parts of one IP datagram, by offset. length: in all, once the last part is there."""

    parts: dict[int, bytes] = field(default_factory=dict)
    length: int | None = None

    def whole(self) -> bytes | None:
        if self.length is None or sum(map(len, self.parts.values())) < self.length:
            return None
        data = b"".join(self.parts[at] for at in sorted(self.parts))
        return data if len(data) == self.length else None


def _udp_payload(packet: bytes, waiting: dict[bytes, _Fragments]) -> bytes | None:
    """The payload of the datagram that this IP packet is, or completes."""
    version = packet[0] >> 4
    if version == 4 and len(packet) >= 20:
        total = int.from_bytes(packet[2:4], "big") or len(packet)
        data, protocol = packet[(packet[0] & 15) * 4 : total], packet[9]
        flags = int.from_bytes(packet[6:8], "big")
        offset, more, key = (flags & 0x1FFF) * 8, bool(flags & 0x2000), packet[4:6] + packet[12:20]
    elif version == 6 and len(packet) >= 48:
        end = 40 + int.from_bytes(packet[4:6], "big")
        data, protocol, offset, more, key = packet[40:end], packet[6], 0, False, b""
        if protocol == _FRAGMENT:
            flags = int.from_bytes(packet[42:44], "big")
            data, protocol = packet[48:end], packet[40]
            offset, more, key = flags & 0xFFF8, bool(flags & 1), packet[44:48] + packet[8:40]
    else:
        return None
    if protocol != _UDP:
        return None
    if offset or more:
        known = waiting.setdefault(key, _Fragments())
        known.parts[offset] = data
        if not more:
            known.length = offset + len(data)
        if len(waiting) > _FRAGMENTS_KEPT:
            del waiting[next(iter(waiting))]
        whole = known.whole()
        if whole is None:
            return None
        waiting.pop(key, None)
        data = whole
    if len(data) < 8:
        return None
    length = int.from_bytes(data[4:6], "big")
    return data[8 : length if length >= 8 else None]
