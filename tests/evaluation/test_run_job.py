"""A part of a recording gives the same measurements as that part of a whole run.

Tests app/evaluation/run_job.py.
"""

from pathlib import Path

import numpy as np
import pytest

from app.evaluation.job import RUN_FILES, Job, finished, reopen
from app.evaluation.run_job import run_job
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.trajectory import read_tum
from tests.cli.conftest import write_walk


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "walk.mcap"
    write_walk(path)
    return path


def test_a_part_in_the_middle_is_entered_early_and_only_it_counts(recording: Path, tmp_path: Path) -> None:
    """The walk is shorter than the lead, so the run that is measured from its middle is the whole run."""

    def run(name: str, start_s: float, baseline: str = "") -> Job:
        job = Job(recording, "x", "walk", name, Params(), tmp_path / name, start_s=start_s, baseline=baseline)
        run_job(job, lambda done, total: None)
        return job

    for baseline in ("", "loam"):
        whole, part = run(f"whole{baseline}", 0.0, baseline), run(f"part{baseline}", 1.0, baseline)
        lines, later = ((job.folder / "trajectory.tum").read_text().splitlines() for job in (whole, part))
        assert 0 < len(later) < len(lines) and lines[-len(later) :] == later
        first, begin = read_tum(part.folder / "trajectory.tum"), read_tum(whole.folder / "trajectory.tum")
        assert 0.9 < (first.stamps_ns[0] - begin.stamps_ns[0]) * 1e-9 <= 1.1
        facts, of_whole = finished(part), finished(whole)
        assert facts is not None and of_whole is not None
        assert facts["frames"] == len(later) and facts["distance_m"] < of_whole["distance_m"]
        assert np.loadtxt(part.folder / "timings.csv", delimiter=",", skiprows=1).shape[0] == len(later)
    with pytest.raises(HemislamError, match="no scan after 4 s"):
        run("late", 4.0)


def test_a_recording_whose_name_is_not_utf_8_is_run_to_its_end(recording: Path, tmp_path: Path) -> None:
    other = tmp_path / "w\udcfflk.mcap"
    other.symlink_to(recording)
    job = Job(other, "x", "walk", "LOAM", Params(), tmp_path / "run", baseline="loam")
    run_job(job, lambda done, total: None)
    facts = finished(job)
    assert facts is not None and facts["recording"] == str(other)


def test_a_run_whose_writing_ends_early_is_not_finished_even_if_one_before_was(tmp_path: Path) -> None:
    job = Job(tmp_path / "walk.mcap", "x", "walk", "a", Params(), tmp_path / "walk" / "a")
    whole = f'{{"key": "{job.key}"}}'
    reopen(job)
    for name in RUN_FILES:
        (job.folder / name).write_text(whole)
    assert finished(job)
    reopen(job)
    assert finished(job) is None
    for length in range(len(whole)):  # run.json comes last
        (job.folder / "run.json").write_text(whole[:length])
        assert finished(job) is None
