"""Suites of simulated walks: twins of the six sequences of the paper's Table 1, and six walks with revisits.

The twins have the same numbers of frames, durations and lengths as the paper's sequences; their places are in
`scenes.rooms` and `scenes.outdoors`. The other walks return to places visited minutes before, in the same and in the
opposite direction. The short form is the first minute of each walk, with fewer firings.
"""

import hashlib
import json
import zlib
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from app.sensors.simulator.imperfections import NONE, Imperfections
from app.sensors.simulator.scenes import build_scene
from app.sensors.simulator.simulate import simulate, trajectory_through
from app.sensors.simulator.trajectory import Walker
from app.slam.errors import HemislamError

RATE_HZ = 10
SHORT_S = 60.0
SHORT_EVERY_BLOCK = 3
"""The short form fires at every third azimuth, 19,000 firings per scan, so that its simulation takes only minutes."""


@dataclass(frozen=True, slots=True)
class Twin:
    """One sequence: a scene, and the numbers of frames and metres. `back`: see `Walker`."""

    scene: str
    frames: int
    length_m: float
    back: bool = False

    @property
    def name(self) -> str:
        return self.scene + ("_back" if self.back else "")

    @property
    def duration_s(self) -> float:
        """Duration of exactly these frames (the first begins after 0.05 s)."""
        return self.frames / RATE_HZ + 0.05


PAPER: tuple[Twin, ...] = (
    Twin("indoor_1", 2266, 218.39),
    Twin("indoor_2", 1252, 54.63),
    Twin("outdoor_1", 3306, 335.59),
    Twin("outdoor_2", 3414, 422.25),
    Twin("outdoor_3", 9530, 869.16),
    Twin("outdoor_4", 5667, 573.64),
)
REVISITS: tuple[Twin, ...] = (
    Twin("corridor", 2000, 205.0),
    Twin("corridor", 2000, 205.0, back=True),
    Twin("museum", 1800, 165.0, back=True),
    Twin("building", 3600, 400.0),
    Twin("outdoor", 2400, 265.0),
    Twin("outdoor", 2400, 265.0, back=True),
)
SUITES = {"paper": PAPER, "revisits": REVISITS}


@dataclass(frozen=True, slots=True)
class Made:
    """Attributes:
    recording: the file. new: whether it was simulated now. distance_m: of the trajectory.
    """

    recording: Path
    new: bool
    distance_m: float


def make_twin(
    twin: Twin,
    folder: Path,
    *,
    seed: int = 0,
    short: bool = False,
    every_block: int | None = None,
    imperfections: Imperfections = NONE,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Made:
    """Simulate one sequence into `folder`, unless it already exists.

    The walker's speed is chosen so that the trajectory has the length of the twin.

    Args:
        every_block: fire only at every k-th azimuth; None: at all, or at every SHORT_EVERY_BLOCK-th if short.

    Raises:
        HemislamError: as `simulate`.
    """
    name = twin.name + (f"-seed{seed}" if seed else "") + ("-short" if short else "")
    name += "" if imperfections == NONE else "-imperfect"
    out, note = folder / f"{name}.mcap", folder / f"{name}.suite.json"
    every_block = every_block or (SHORT_EVERY_BLOCK if short else 1)
    duration_s = min(SHORT_S, twin.duration_s) if short else twin.duration_s
    wanted = {"twin": asdict(twin), "seed": seed, "duration_s": duration_s, "every_block": every_block}
    wanted |= {"simulator": _digest(), "imperfections": asdict(imperfections)}
    there = _noted(note) if out.is_file() else {}
    if there.get("made") == wanted:
        return Made(out, False, there["distance_m"])
    made = simulate(
        twin.scene,
        out,
        duration_s=duration_s,
        seed=seed,
        rate_hz=RATE_HZ,
        every_block=every_block,
        walker=Walker(speed=fitting_speed(twin, seed), back=twin.back),
        imperfections=imperfections,
        unit_seed=unit_seed(twin, seed),
        progress=progress,
    )
    note.write_text(json.dumps({"made": wanted, "distance_m": made.distance_m}, indent=2) + "\n", encoding="utf-8")
    return Made(out, True, made.distance_m)


def unit_seed(twin: Twin, seed: int) -> int:
    """Each walk has a scanner of its own; otherwise the errors of a suite would be those of a single scanner."""
    return zlib.crc32(f"{twin.name} {seed}".encode())


def fitting_speed(twin: Twin, seed: int) -> float:
    """Speed, m/s, at which the trajectory has the length of the twin to about a centimetre."""
    place = build_scene(twin.scene, seed)
    times = np.arange(0.0, twin.duration_s, 1 / RATE_HZ)
    speed = twin.length_m / (twin.duration_s - 4.0)
    for _ in range(6):
        path = trajectory_through(place, twin.duration_s, seed, Walker(speed=speed, back=twin.back)).poses(times)[0]
        length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
        speed *= twin.length_m / length
    return speed


def find_suite(name: str) -> tuple[Twin, ...]:
    """Find a suite by name. Raises HemislamError if there is none."""
    if name not in SUITES:
        raise HemislamError(f"There is no suite `{name}`; there is {', '.join(SUITES)}.")
    return SUITES[name]


def _noted(path: Path) -> dict[str, Any]:
    """The content of the note beside a recording; {} if there is none."""
    try:
        noted = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return noted if isinstance(noted, dict) and {"made", "distance_m"} <= noted.keys() else {}


def _digest() -> str:
    """Hash of the simulator's code, since changed code produces different recordings."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
