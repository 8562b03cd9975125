"""A recording, frame by frame: first the doctor's findings, then each scan with its IMU samples.

python examples/read_frames.py sample_data/cloister.mcap
"""

import sys
from pathlib import Path

from app.sensors.recording import open_recording
from app.slam.params import Params
from app.slam.types import DroppedScan

path = Path(sys.argv[1])
beside = path.with_suffix(".params.yaml")
params = Params().merged_yaml(beside.read_text()) if beside.exists() else Params()

with open_recording(path, params) as recording:
    for finding in recording.findings:
        print(f"{finding.verdict:<10} {finding.subject}: {finding.text}")
    for number, entry in enumerate(recording.measurements(duration_s=2.0)):
        if isinstance(entry, DroppedScan):
            print(f"scan at {entry.stamp_ns} ns is left out: {entry.reason}")
            continue
        scan, imu = entry.scan, entry.imu
        seconds = (scan.stamp_ns - recording.start_ns) * 1e-9
        print(f"frame {number}: {seconds:.3f} s, {len(scan):,} points, {len(imu)} IMU samples", *entry.notices)
