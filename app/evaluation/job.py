"""A job: one recording with one variant or baseline, and the files that its run writes.

A run's folder holds trajectory.tum, timings.csv, crops.npz and, written last, run.json with a key that covers
everything on which the results depend. A folder with the right key is finished and is never run again.
"""

import hashlib
import json
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from app import __version__
from app.baselines.systems import find_system
from app.mapping.feed import FeedInfo
from app.slam.params import Params

FORMAT = 3
LEAD_S = 5.0
"""Reading usually begins this much before a part in the middle of a recording; this lead does not count. A start while
walking has no rest by which to level the map: its error would be larger than the effect of any parameter."""
GROUND_RANGES_M = (0.0, 5.0, 10.0, 20.0, 40.0, 100.0)
RUN_FILES = ("trajectory.tum", "timings.csv", "crops.npz", "run.json")


@cache
def code_digest() -> str:
    """Hash of the code on which results depend, so that jobs run again after a change."""
    root = Path(__file__).parents[1]
    files = [path for room in ("slam", "mapping", "baselines") for path in (root / room).rglob("*.py")]
    files += [path for path in (root / "sensors").rglob("*.py") if "simulator" not in path.parts]
    files += [root / "export" / "results.py"]
    files += [root / "evaluation" / name for name in ("job.py", "run_job.py", "map_sharpness.py", "crops.py")]
    digest = hashlib.sha256()
    for path in sorted(files):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


@dataclass(frozen=True, slots=True)
class Job:
    """Attributes:
    recording: its path. sha256: of its bytes. name: of the recording in tables. variant: its name.
    params: all parameters of the run. folder: for the results. code: `code_digest()`.
    start_s, duration_s: the part of the recording that counts, after its first scan; None: to the end.
    lead_s: reading begins up to this much earlier.
    baseline: name of the system that replaces the engine; "" for the engine.
    marks: (stamp of a frame, one byte per point of its cloud as in `app.mapping.painted`); they replace the
        recording's ground labels.
    """

    recording: Path
    sha256: str
    name: str
    variant: str
    params: Params
    folder: Path
    start_s: float = 0.0
    duration_s: float | None = None
    lead_s: float = LEAD_S
    code: str = field(default_factory=code_digest)
    baseline: str = ""
    marks: tuple[tuple[int, bytes], ...] = ()
    key: str = field(init=False)
    """Hash of everything on which a result depends, except the machine and its load."""

    def __post_init__(self) -> None:
        parts = {
            "format": FORMAT,
            "version": __version__,
            "code": self.code,
            "input": self.sha256,
            "parameters": self.params.model_dump(mode="json"),
            "part": [*self.read, self.start_s],
            "baseline": [self.baseline, find_system(self.baseline).version()] if self.baseline else None,
            "marks": [[stamp, hashlib.sha256(labels).hexdigest()] for stamp, labels in self.marks],
        }
        key = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()
        object.__setattr__(self, "key", key)  # once, by its maker, so that all processes agree

    @property
    def read(self) -> tuple[float, float | None]:
        """Start and length (s) of the part to read, including the lead."""
        lead = min(self.lead_s, self.start_s)
        return self.start_s - lead, None if self.duration_s is None else self.duration_s + lead

    def begin_ns(self, info: FeedInfo) -> int:
        """Time at which the part begins."""
        return info.start_ns + round(self.start_s * 1e9)


def finished(job: Job) -> dict[str, Any] | None:
    """The content of run.json if the job was completed with exactly these inputs; otherwise None."""
    report = read_run(job.folder)
    return report if report is not None and report.get("key") == job.key else None


def read_run(folder: Path) -> dict[str, Any] | None:
    """The content of run.json in a run's folder; None if it cannot be read or a file of the run is missing."""
    try:
        report = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    whole = all((folder / name).is_file() for name in RUN_FILES)
    return report if whole and isinstance(report, dict) else None


def reopen(job: Job) -> None:
    """Make the job's folder, marked unfinished. run.json is written last, so a kill before that leaves no result."""
    job.folder.mkdir(parents=True, exist_ok=True)
    (job.folder / "run.json").unlink(missing_ok=True)
