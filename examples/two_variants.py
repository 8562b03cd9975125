"""Evaluate two variants on one recording, and write a report to FOLDER.

python examples/two_variants.py sample_data/cloister.mcap FOLDER
"""

import sys
from functools import partial
from pathlib import Path

from app.evaluation.evaluate import Subject, evaluate
from app.evaluation.runner import run_jobs
from app.evaluation.truth import read_truth
from app.evaluation.variants import Variant
from app.slam.params import Params

if __name__ == "__main__":  # each run has its own process, which imports this file
    recording, folder = Path(sys.argv[1]), Path(sys.argv[2])
    params = Params().merged_yaml(recording.with_suffix(".params.yaml").read_text())
    truth = read_truth(str(recording.with_name(f"{recording.stem}_truth.tum")))
    variants = (
        Variant("default", {}),
        Variant("fine", {"scan.voxel_size": 0.2}, "finer voxels for the filter"),
    )
    subject = Subject(recording.stem, recording, params, truth)
    run = partial(run_jobs, parallel=2)
    findings, failed = evaluate([subject], variants, folder, run=run, duration_s=10.0)
    print(*findings, *failed.values(), sep="\n")
    print((folder / "report.md").read_text())
