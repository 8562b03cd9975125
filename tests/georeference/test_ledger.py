"""The report on each fix. Tests app/georeference/ledger.py and app/evaluation/plots.py."""

import csv
import io
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest

from app.evaluation.plots import georeference_plot
from app.georeference.align import Alignment, align
from app.georeference.ledger import residuals_csv, summary, table
from tests.georeference.walks import LEVER, Walked, walked


@pytest.fixture(scope="module")
def made() -> Walked:
    return walked()


@pytest.fixture(scope="module")
def found(made: Walked) -> Alignment:
    return align(made.trajectory, made.fixes, lever=LEVER)


def test_every_fix_is_in_the_file_with_its_residual_and_verdict(made: Walked, found: Alignment) -> None:
    rows = list(csv.DictReader(io.StringIO(residuals_csv(found))))
    assert [row["name"] for row in rows] == list(found.names)
    far = {row["name"] for row in rows if np.hypot(float(row["d_east_m"]), float(row["d_north_m"])) > 1.0}
    assert far <= {row["name"] for row in rows if row["verdict"] == "rejected"}
    assert float(rows[5]["east_m"]) == pytest.approx(found.grid[5, 0], abs=1e-4)


def test_the_summary_names_units_and_the_rejected_fixes_follow(made: Walked, found: Alignment) -> None:
    lines = "\n".join(summary(found, "fixes"))
    assert "EPSG:32632 (WGS 84 / UTM zone 32N), heights ellipsoidal" in lines
    assert "Clock offset       79.3 ms ± 1.0" in lines and " ms (the fixes are stamped late)" in lines
    rejected = table(found, only_rejected=True)[1:]
    assert {line.split()[0] for line in rejected} >= {str(n) for n in made.outliers if str(n) in found.names}
    assert all("rejected" in line for line in rejected)


def test_who_has_an_uncertain_offset_is_told_how_to_determine_it_better(found: Alignment) -> None:
    def advice(sigma_s: float) -> bool:
        lines = "\n".join(summary(replace(found, offset_sigma_s=sigma_s), "fixes"))
        return f"uncertain by {sigma_s * 1e3:.1f} ms; to determine it better, walk longer" in lines

    assert advice(0.0023) and not advice(0.0009) and not advice(float("nan"))


def test_the_picture_shows_a_mark_for_every_rejected_fix(made: Walked, found: Alignment) -> None:
    svg = georeference_plot(found, made.trajectory.positions)
    assert ET.fromstring(svg).tag.endswith("svg")
    assert svg.count("<title>rejected</title>") == (~found.used).sum()
