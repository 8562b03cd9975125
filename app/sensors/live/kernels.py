"""The numba kernel that turns a revolution of packets into points. Bare arrays; see `decoder.py`."""

import math

import numpy as np
from numba import njit

from app.sensors.live.msop import HEADER_BYTES, TURN

_GAP = 100
"""0.01 deg: a longer step between two blocks is the gap of a limited field of view."""


@njit(cache=True, nogil=True, error_model="numpy")
def decode_blocks(
    packets, stamps, first, stop, reverse, nominal, turn_ns,
    cos_e, sin_e, cos_h, sin_h, share, firing_ns, rings, blocks, parts, part, counted, block_ns, step_m,
    least, most, rx, rz, points, times, intensity, ring,
):  # fmt: skip
    """Points of the blocks from `first` of the first packet up to `stop` of the last. Returns (points, bad blocks).

    Args:
        packets: (n, 1248) u8. stamps: (n,) i64 ns of each packet's first block, after the frame's base.
        nominal: 0.01 deg from block to block, signed. turn_ns: of a revolution.
        cos_e ... sin_h: (c,) of elevation and horizontal correction. share: (c,) of the block's
            duration at which a channel fires. rings: (c,) u16. step_m: m per count.
        blocks, parts, part: blocks of a packet, parts of a block, channels of a part. counted: bits of a distance.
        least, most: counts outside are no return.
        points (m, 3) f32, times (m,) i64 after the base, intensity (m,) f32, ring (m,) u16: filled.
    """
    n = 0
    bad = 0
    last = len(packets) - 1
    part_bytes = 4 + 3 * part
    block_bytes = parts * part_bytes
    azimuth = np.empty(blocks, np.int64)
    to_radians = math.pi / 18000.0
    for i in range(len(packets)):
        packet = packets[i]
        for b in range(blocks):
            at = HEADER_BYTES + b * block_bytes
            azimuth[b] = (packet[at + 2] << 8) | packet[at + 3]
        time = stamps[i]
        step = nominal
        begin = first if i == 0 else 0
        end = stop if i == last else blocks
        for b in range(end):
            if b > 0 and azimuth[b] != azimuth[b - 1]:  # else it is another return of the same firing
                moved = (azimuth[b] - azimuth[b - 1] + TURN // 2) % TURN - TURN // 2
                if abs(moved) > _GAP:
                    time += round(turn_ns * ((moved if nominal > 0 else -moved) % TURN) / TURN)
                else:
                    time += block_ns
            if b < begin:
                continue
            at = HEADER_BYTES + b * block_bytes
            if packet[at] != 0xFF or packet[at + 1] != 0xEE or azimuth[b] >= TURN:
                bad += 1
                continue
            following = b + 1
            while following < blocks and azimuth[following] == azimuth[b]:
                following += 1
            if following < blocks:
                moved = (azimuth[following] - azimuth[b] + TURN // 2) % TURN - TURN // 2
                step = moved if abs(moved) <= _GAP else nominal
            again = b > begin and azimuth[b] == azimuth[b - 1]
            turned = azimuth[b] * to_radians
            width = step * to_radians
            if reverse:
                turned, width = -turned, -width
            cb, sb = math.cos(turned), math.sin(turned)
            lx, ly = rx * cb, -rx * sb
            for c in range(parts * part):
                p = at + (c // part) * part_bytes + 4 + 3 * (c % part)
                count = ((packet[p] << 8) | packet[p + 1]) & counted
                if count < least or count > most:
                    continue
                if again and packet[p - block_bytes] == packet[p] and packet[p + 1 - block_bytes] == packet[p + 1]:
                    continue  # strongest and last return are the same
                # The head turns on by at most 1 deg within a block: the series is exact to 1e-13.
                w = width * share[c]
                w2 = w * w
                cw, sw = 1.0 - w2 * (0.5 - w2 / 24.0), w * (1.0 - w2 / 6.0)
                ca, sa = cb * cw - sb * sw, sb * cw + cb * sw
                ch, sh = ca * cos_h[c] - sa * sin_h[c], sa * cos_h[c] + ca * sin_h[c]
                distance = count * step_m
                flat = distance * cos_e[c]
                points[n, 0] = flat * ch + lx
                points[n, 1] = -flat * sh + ly
                points[n, 2] = distance * sin_e[c] + rz
                times[n] = time + firing_ns[c]
                intensity[n] = packet[p + 2]
                ring[n] = rings[c]
                n += 1
    return n, bad
