"""The recordings for the benchmarks: simulated once, at the sensor's full resolution, and kept in build/."""

from pathlib import Path

from tqdm import tqdm

from app.sensors.simulator import simulate

FOLDER = Path(__file__).resolve().parents[1] / "build" / "benchmarks"
SCENES = ("corridor", "outdoor")
DURATION_S = 15.0


def recording(scene: str) -> Path:
    """A 15 s walk through the scene with 57,632 firings per scan."""
    return _simulated(f"{scene}.mcap", scene, DURATION_S, seed=1)


def long_recording() -> Path:
    """Ten minutes of laps in a building, with every 6th azimuth, so that the file stays small."""
    return _simulated("long.mcap", "building", 600.0, seed=3, every_block=6)


def walk_in_laps() -> Path:
    """Eight minutes of laps in a building, with every 6th azimuth: over 1,000 keyframes, most of them revisits."""
    return _simulated("laps.mcap", "building", 480.0, seed=3, every_block=6)


def outdoors(minutes: int) -> Path:
    """Outdoors, with every 6th azimuth: 870 m of new ground in a quarter of an hour, then the same way again."""
    return _simulated(f"outdoors-{minutes}-min.mcap", "outdoor_3", 60.0 * minutes + 30.0, seed=7, every_block=6)


def half_hour_in_laps() -> Path:
    """Half an hour of laps in a building, with every 6th azimuth: 2.2 km, nearly all of it revisits."""
    return _simulated("half-hour-in-laps.mcap", "building", 1830.0, seed=7, every_block=6)


def _simulated(name: str, scene: str, duration_s: float, *, seed: int, every_block: int = 1) -> Path:
    path = FOLDER / name
    if not path.exists():
        FOLDER.mkdir(parents=True, exist_ok=True)
        with tqdm(desc=f"Simulating {name}", unit=" scans", leave=False, disable=None) as bar:

            def progress(done: int, total: int) -> None:
                bar.total = total
                bar.update(done - bar.n)

            simulate(scene, path, duration_s=duration_s, seed=seed, every_block=every_block, progress=progress)
    return path
