"""Packets of a rotating sensor gathered into turns, though UDP swaps, repeats and loses some."""

from collections.abc import Iterator

LATE = 4
"""After this many packets of the next turn, packets of this one are no longer waited for."""


class Turns:
    """Turns are numbered by the sensor, with 16 bits; a packet is known by its turn and its first column."""

    def __init__(self, whole: int) -> None:
        """whole: packets of a full turn."""
        self._whole = whole
        self._open: dict[int, dict[int, bytes]] = {}
        self._ended: int | None = None

    def add(self, turn: int, column: int, packet: bytes) -> Iterator[list[bytes]]:
        """The turns that this packet shows to be over, each in order of its columns."""
        if turn not in self._open:
            if self._ended is not None and _ahead(turn, self._ended) in (-1, 0):
                return  # too late
            if any(abs(_ahead(turn, other)) > 1 for other in self._open):  # turns were lost, or the sensor restarted
                yield from self.rest()
        there = self._open.get(turn, {}).get(column)
        if there == packet:
            return  # it came twice
        if there is not None:  # the number stands still
            yield self._end(turn)
        self._open.setdefault(turn, {})[column] = packet
        first = min(self._open, key=lambda other: _ahead(other, turn))
        later = sum(len(packets) for other, packets in self._open.items() if other != first)
        if later > LATE or (later and len(self._open[first]) == self._whole):
            yield self._end(first)

    def rest(self) -> Iterator[list[bytes]]:
        """The turns that remain when no more packets come."""
        while self._open:
            some = next(iter(self._open))
            yield self._end(min(self._open, key=lambda other: _ahead(other, some)))

    def _end(self, turn: int) -> list[bytes]:
        self._ended = turn
        return [packet for _, packet in sorted(self._open.pop(turn).items())]


def _ahead(turn: int, of: int) -> int:
    """By how many turns, around the counter's end."""
    return (turn - of + 0x8000) % 0x10000 - 0x8000
