"""The recordings to measure on: simulated once, at the sensor's full resolution, and kept in build/."""

from pathlib import Path

from tqdm import tqdm

from app.sensors.simulator import simulate

FOLDER = Path(__file__).resolve().parents[1] / "build" / "benchmarks"
SCENES = ("corridor", "outdoor")
DURATION_S = 15.0


def recording(scene: str) -> Path:
    """A 15 s walk through the scene, 57,632 firings a scan."""
    path = FOLDER / f"{scene}.mcap"
    if not path.exists():
        FOLDER.mkdir(parents=True, exist_ok=True)
        with tqdm(desc=f"Simulating {scene}", unit=" scans", leave=False, disable=None) as bar:

            def progress(done: int, total: int) -> None:
                bar.total = total
                bar.update(done - bar.n)

            simulate(scene, path, duration_s=DURATION_S, seed=1, progress=progress)
    return path
