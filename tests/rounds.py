"""Short simulated walks that return to their start, for tests of loops."""

from pathlib import Path

from app.sensors.simulator import simulate
from app.sensors.simulator.imperfections import IMPERFECT, NONE
from app.sensors.simulator.trajectory import Walker

ROUND_S = 12.0
AS_LOOPS = "loops.min_time=4"
"""The setting that lets so short a round count as a loop."""


def walk_round(path: Path, *, perfect: bool = False) -> Path:
    """Write a brisk walk round a room, of a sensor with or without errors. Returns the path."""
    seed, errors = (0, NONE) if perfect else (3, IMPERFECT)
    brisk = Walker(speed=1.8, still=1.5)
    simulate("room", path, duration_s=ROUND_S, seed=seed, every_block=16, walker=brisk, imperfections=errors)
    return path
