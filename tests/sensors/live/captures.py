"""Capture files written with `struct` alone, with the link layers, tags and fragments that occur in networks."""

import struct
from collections.abc import Iterable

Entry = tuple[int, int, bytes]
"""Capture time ns, UDP port, payload."""


def udp(port: int, payload: bytes) -> bytes:
    return struct.pack(">4H", 40_000, port, 8 + len(payload), 0) + payload


def ipv4(payload: bytes, *, number: int = 1, flags: int = 0, host: int = 200) -> bytes:
    total, number = 20 + len(payload), number & 0xFFFF
    return struct.pack(">BBHHHBBHII", 0x45, 0, total, number, flags, 64, 17, 0, 0xC0A80100 + host, 0xC0A80166) + payload


def ipv6(payload: bytes, *, host: int = 200) -> bytes:
    return struct.pack(">IHBB15xB16x", 6 << 28, len(payload), 17, 64, host) + payload


def packets(entry: Entry, shape: str, number: int, host: int = 200) -> list[bytes]:
    """The frames of one datagram.

    shape: plain, vlan, double-vlan, fragments, ipv6, raw, cooked, loopback. host: last byte of the sender's address.
    """
    _, port, payload = entry
    data = udp(port, payload)
    ethernet = b"\x01" * 6 + b"\x02" * 6
    if shape == "fragments":
        parts = [data[at : at + 528] for at in range(0, len(data), 528)]
        made = []
        for k, part in enumerate(parts):
            more = 0x2000 if k < len(parts) - 1 else 0
            made.append(ethernet + b"\x08\x00" + ipv4(part, number=number, flags=more | k * 528 // 8, host=host))
        return made[::-1] if number % 3 == 0 else made
    packet = ipv4(data, host=host)
    match shape:
        case "vlan":
            return [ethernet + b"\x81\x00\x00\x05\x08\x00" + packet]
        case "double-vlan":
            return [ethernet + b"\x88\xa8\x00\x05\x81\x00\x00\x06\x08\x00" + packet]
        case "ipv6":
            return [ethernet + b"\x86\xdd" + ipv6(data, host=host)]
        case "raw":
            return [packet]
        case "cooked":
            return [bytes(14) + b"\x08\x00" + packet]
        case "loopback":
            return [struct.pack("<I", 2) + packet]
        case _:
            return [ethernet + b"\x08\x00" + packet + bytes(4)]


LINKS = {"raw": 101, "cooked": 113, "loopback": 0}


def pcap(
    entries: Iterable[Entry],
    shape: str = "plain",
    *,
    order: str = "<",
    nanoseconds: bool = True,
    others: Iterable[Entry] = (),
    most: int = 65535,
) -> bytes:
    """others: sent by another host. most: bytes of a frame that are captured."""
    magic = 0xA1B23C4D if nanoseconds else 0xA1B2C3D4
    out = [struct.pack(order + "IHHiIII", magic, 2, 4, 0, 0, 65535, LINKS.get(shape, 1))]
    rows = [(entry, 200) for entry in entries]
    if others := list(others):
        rows = sorted(rows + [(entry, 201) for entry in others], key=lambda row: row[0][0])
    for number, (entry, host) in enumerate(rows):
        for frame in packets(entry, shape, number, host):
            seconds, rest = divmod(entry[0], 10**9)
            fraction, size = rest if nanoseconds else rest // 1000, min(len(frame), most)
            out.append(struct.pack(order + "4I", seconds, fraction, size, len(frame)))
            out.append(frame[:size])
    return b"".join(out)


def pcapng(
    entries: Iterable[Entry], shape: str = "plain", *, order: str = "<", exponent: int = 9, most: int = 65535
) -> bytes:
    def block(kind: int, body: bytes) -> bytes:
        body += bytes(-len(body) % 4)
        length = struct.pack(order + "I", 12 + len(body))
        return struct.pack(order + "I", kind) + length + body + length

    section = block(0x0A0D0D0A, struct.pack(order + "IHHq", 0x1A2B3C4D, 1, 0, -1))
    option = struct.pack(order + "HHBxxx", 9, 1, exponent) + struct.pack(order + "HH", 0, 0)
    other = block(1, struct.pack(order + "HHI", 1, 0, 0))
    out = [
        section,
        other,
        block(1, struct.pack(order + "HHI", LINKS.get(shape, 1), 0, 0) + option),
        block(5, bytes(12)),
    ]
    for number, entry in enumerate(entries):
        for frame in packets(entry, shape, number):
            units = entry[0] // 10 ** (9 - exponent)
            size = min(len(frame), most)
            body = struct.pack(order + "5I", 1, units >> 32, units & 0xFFFFFFFF, size, len(frame)) + frame[:size]
            out.append(block(6, body))
    return b"".join(out)
