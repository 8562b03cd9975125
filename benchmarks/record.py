"""Measurements as a table on the screen and as lines appended to benchmarks/results.csv."""

import csv
import subprocess
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import numpy.typing as npt

from app import __version__
from app.slam.provenance import describe_machine

RESULTS = Path(__file__).parent / "results.csv"
COLUMNS = ("when", "version", "commit", "processor", "cores", "what", "on", "unit", "median", "p95", "max", "count")


@dataclass(frozen=True, slots=True)
class Line:
    """One measurement: median, 95th percentile and maximum over `count` samples."""

    what: str
    on: str
    unit: str
    median: float
    p95: float
    max: float
    count: int

    @classmethod
    def of(cls, what: str, on: str, unit: str, samples: npt.ArrayLike) -> "Line":
        values = np.asarray(samples, dtype=np.float64)
        return cls(
            what, on, unit, float(np.median(values)), float(np.percentile(values, 95)), float(values.max()), values.size
        )


def show(lines: list[Line]) -> None:
    """Print the lines as a table and append them to the file, with the time and the machine."""
    width = max(len(line.what) for line in lines)
    previous = None
    for line in lines:
        if line.on != previous:
            print(f"\n{line.on}\n{'':{width}}  {'median':>9} {'p95':>9} {'max':>9}")
            previous = line.on
        print(f"{line.what:{width}}  {line.median:9.2f} {line.p95:9.2f} {line.max:9.2f}  {line.unit}")
    machine = describe_machine()
    where = (datetime.now(UTC).isoformat(timespec="seconds"), __version__, _commit())
    new = not RESULTS.exists()
    with RESULTS.open("a", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        if new:
            writer.writerow(COLUMNS)
        for line in lines:
            numbers = [f"{value:.3f}" for value in (line.median, line.p95, line.max)]
            writer.writerow(
                [*where, machine["processor"], machine["cores"], line.what, line.on, line.unit, *numbers, line.count]
            )


def _commit() -> str:
    command = ["git", "describe", "--always", "--dirty"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=Path(__file__).parent)
    return done.stdout.strip() if done.returncode == 0 else ""
