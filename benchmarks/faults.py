"""Put faults into the scans and IMU samples of a recording, and compare odometry with the truth.

    python -m benchmarks.faults walk.mcap other.mcap
    python -m benchmarks.faults walk.mcap --preset mid360 --only rain --only "every tenth scan lost"

Loops are not searched for. Each fault is drawn with the same seed in every run.
"""

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from app.sensors.presets import resolve_params
from app.sensors.recording import open_recording
from app.slam.engine import Engine
from app.slam.metrics import Ate, ate
from app.slam.params import Params
from app.slam.trajectory import Trajectory, read_tum, truth_beside
from app.slam.types import F64, FrameStatus, ImuSamples, Measurement, Scan
from app.slam.warmup import compile_kernels

PACKET_NS = 1_000_000
"""About the time that the points of one packet take."""


@dataclass
class Moment:
    """One measurement on its way to the engine. A fault changes it.

    Attributes:
        index: of the scan. since_s: time since the first scan.
        lost: whether the scan does not arrive; its samples then wait for the next one.
    """

    scan: Scan
    imu: ImuSamples
    index: int
    since_s: float
    rng: np.random.Generator
    lost: bool = False

    def change_ranges(self, changed: F64) -> None:
        """Replace the ranges of points; nan leaves a range as it is. changed: (n,) m."""
        points = self.scan.points.astype(np.float64)
        measured = np.linalg.norm(points, axis=1)
        factor = np.where(np.isnan(changed), 1.0, changed / measured)
        self.scan = replace(self.scan, points=(points * factor[:, None]).astype(np.float32))

    def add_errors(self, gyro: F64, accel: F64 | None = None) -> None:
        """Add errors (rad/s, m/s²) to the samples: (3,), or (k, 3)."""
        accel = np.zeros(3) if accel is None else accel
        self.imu = replace(self.imu, gyro=self.imu.gyro + gyro, accel=self.imu.accel + accel)


def rain(moment: Moment) -> None:
    """A fifth of all beams return from drops or dust within four metres, if nothing else is nearer."""
    measured = np.linalg.norm(moment.scan.points, axis=1)
    drops = moment.rng.uniform(0.4, 4.0, len(measured))
    hit = (moment.rng.random(len(measured)) < 0.2) & (drops < measured)
    moment.change_ranges(np.where(hit, drops, np.nan))


def strays(moment: Moment) -> None:
    """Three of a hundred ranges are arbitrary."""
    stray = moment.rng.random(len(moment.scan)) < 0.03
    moment.change_ranges(np.where(stray, moment.rng.uniform(0.4, 60.0, len(stray)), np.nan))


def every_tenth_scan_lost(moment: Moment) -> None:
    moment.lost = moment.index % 10 == 9


def half_of_the_packets_lost(moment: Moment) -> None:
    packet = moment.scan.offsets_ns // PACKET_NS
    arrives = moment.rng.random(int(packet.max(initial=0)) + 1) < 0.5
    moment.scan = moment.scan.part(arrives[packet])


def quarter_of_each_scan_lost(moment: Moment) -> None:
    """All points of a quarter of the time of each scan, at another place in each."""
    share = moment.scan.offsets_ns / max(int(moment.scan.offsets_ns.max(initial=0)), 1)
    begin = moment.rng.uniform(0.0, 0.75)
    moment.scan = moment.scan.part((share < begin) | (share > begin + 0.25))


def gyroscope_drifts(moment: Moment) -> None:
    """The bias changes by 0.012 rad/s within thirty seconds, more than that of a cold gyroscope that warms up."""
    moment.add_errors(np.array([0.005, -0.005, 0.01]) * min(moment.since_s / 30.0, 1.0))


def noisy_imu(moment: Moment) -> None:
    """White noise of 0.05 rad/s and 0.5 m/s² on each sample, ten and more times that of a consumer IMU."""
    shape = moment.imu.gyro.shape
    moment.add_errors(0.05 * moment.rng.normal(size=shape), 0.5 * moment.rng.normal(size=shape))


def coarse_imu(moment: Moment) -> None:
    """Readings are rounded to 0.01 rad/s and 0.05 m/s²."""
    imu = moment.imu
    moment.imu = replace(imu, gyro=np.rint(imu.gyro / 0.01) * 0.01, accel=np.rint(imu.accel / 0.05) * 0.05)


def every_fourth_sample_of_the_imu(moment: Moment) -> None:
    imu = moment.imu
    moment.imu = ImuSamples(imu.stamps_ns[::4], imu.gyro[::4], imu.accel[::4])


def stamps_of_the_imu_vary(moment: Moment) -> None:
    """By 2 ms (standard deviation), in the same order."""
    imu = moment.imu
    stamps_ns, first = np.unique(
        imu.stamps_ns + np.rint(2e6 * moment.rng.normal(size=len(imu))).astype(np.int64), return_index=True
    )
    moment.imu = ImuSamples(stamps_ns, imu.gyro[np.sort(first)], imu.accel[np.sort(first)])


FAULTS: dict[str, Callable[[Moment], None]] = {
    "none": lambda moment: None,
    "rain": rain,
    "strays": strays,
    "every tenth scan lost": every_tenth_scan_lost,
    "half of the packets lost": half_of_the_packets_lost,
    "quarter of each scan lost": quarter_of_each_scan_lost,
    "gyroscope drifts": gyroscope_drifts,
    "noisy IMU": noisy_imu,
    "coarse IMU": coarse_imu,
    "every fourth IMU sample": every_fourth_sample_of_the_imu,
    "stamps of the IMU vary": stamps_of_the_imu_vary,
}


def with_fault(
    measurements: Iterable[Measurement], fault: Callable[[Moment], None]
) -> Iterator[tuple[Scan, ImuSamples]]:
    """The scans and samples with a fault. Samples stay in order of time, and none is lost with a scan."""
    rng, first_ns, held = np.random.default_rng(0), None, None
    for index, measurement in enumerate(measurements):
        first_ns = measurement.scan.stamp_ns if first_ns is None else first_ns
        since_s = (measurement.scan.stamp_ns - first_ns) * 1e-9
        moment = Moment(measurement.scan, measurement.imu, index, since_s, rng)
        fault(moment)
        held = moment.imu if held is None else _joined(held, moment.imu)
        if not moment.lost:
            yield moment.scan, held
            held = None


def _joined(before: ImuSamples, after: ImuSamples) -> ImuSamples:
    new = after.stamps_ns > before.stamps_ns[-1] if len(before) else np.ones(len(after), np.bool_)
    columns = ((getattr(before, name), getattr(after, name)[new]) for name in ("stamps_ns", "gyro", "accel"))
    return ImuSamples(*map(np.concatenate, columns))


def measure(recording: Path, truth: Trajectory, params: Params, fault: Callable[[Moment], None]) -> tuple[Ate, int]:
    """The error of odometry with a fault, and the number of scans that were lost."""
    engine, stamps_ns, poses, lost = Engine(params), list[int](), list[F64](), 0
    with open_recording(recording, params) as source:
        entries = (entry for entry in source.measurements() if isinstance(entry, Measurement))
        for scan, samples in with_fault(entries, fault):
            result = engine.step(scan, samples)
            stamps_ns.append(result.stamp_ns)
            poses.append(result.state.T_odom_imu)
            lost += result.status is FrameStatus.LOST
    engine.close()
    return ate(Trajectory.from_poses(stamps_ns, poses), truth), lost


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.faults", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--preset", help="of the device, for all recordings")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="a parameter, for all of them")
    parser.add_argument("--only", action="append", choices=FAULTS, help="one fault; may be repeated")
    chosen = parser.parse_args()
    compile_kernels()
    print("| recording | fault | ATE, m | greatest error, m | scans lost |\n| --- | --- | ---: | ---: | ---: |")
    for recording in chosen.recordings:
        if (truth := truth_beside(recording)) is None:
            sys.exit(f"{recording} has no truth beside it.")
        params = resolve_params(recording, chosen.preset, None, chosen.set)
        for name in chosen.only or FAULTS:
            found, lost = measure(recording, read_tum(truth), params, FAULTS[name])
            print(
                f"| {recording.stem} | {name} | {found.position.rmse:.4f} | {found.position.max:.3f} | {lost} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
