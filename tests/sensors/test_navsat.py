"""Fixes in recordings. Tests app/sensors/navsat.py and app/sensors/simulator/gnss.py."""

from pathlib import Path

import numpy as np
import pytest

from app.georeference.fixes import Fixes
from app.georeference.reference import GeoReference
from app.sensors.navsat import fix_of, navsat_message, recorded_fixes
from app.sensors.recording import open_recording
from app.sensors.simulator.gnss import Gnss
from app.sensors.simulator.simulate import simulate
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.trajectory import read_tum
from app.slam.types import Measurement


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("gnss") / "walk.mcap"
    gnss = Gnss(offset=0.08, noise=0.001, z=0.5, rate=10.0)
    simulate("room", out, duration_s=4.0, every_block=40, gnss=gnss)
    return out


def test_a_simulated_receiver_writes_fixes_that_lie_where_the_truth_does(recording: Path) -> None:
    fixes = recorded_fixes(recording)
    truth = read_tum(recording.with_name("walk_truth.tum"))
    where = GeoReference.from_json(recording.with_name("walk_georeference.json").read_text())
    antenna = truth.positions + truth.rotations.apply([0.0, 0.0, 0.5])
    there = where.to_geographic(antenna)
    measured = (fixes.stamps_ns - 80_000_000).astype(np.float64)
    at = np.column_stack([np.interp(measured, truth.stamps_ns.astype(np.float64), column) for column in there.T])
    inside = (measured > truth.stamps_ns[0]) & (measured < truth.stamps_ns[-1])
    np.testing.assert_allclose(fixes.places[inside, :2], at[inside, :2], atol=1e-7, rtol=0)  # 1 cm
    np.testing.assert_allclose(fixes.places[inside, 2], at[inside, 2], atol=0.01)
    assert len(fixes) == 39 and inside.sum() > 30
    np.testing.assert_allclose(fixes.sigmas, 0.001)


def test_fixes_come_with_the_scan_that_they_were_measured_in(recording: Path) -> None:
    with open_recording(recording, Params()) as opened:
        assert opened.gnss_topic == "/fix"
        entries = [entry for entry in opened.measurements() if isinstance(entry, Measurement)]
    stamps = [entry.streams[Fixes].stamps_ns for entry in entries if Fixes in entry.streams]
    for entry in entries:
        assert Fixes not in entry.streams or entry.streams[Fixes].stamps_ns[-1] <= entry.scan.end_ns
    assert np.concatenate(stamps).tolist() == recorded_fixes(recording).stamps_ns[: sum(map(len, stamps))].tolist()
    assert sum(map(len, stamps)) >= 35


def test_a_fix_survives_its_message_and_a_covariance_of_unknown_type_is_unknown() -> None:
    fixes = Fixes.of([5], [[48.1, 11.5, 520.0]], [[0.1, 0.2, 0.3]])
    back = fix_of(navsat_message(fixes, 0))
    np.testing.assert_allclose(back.sigmas, fixes.sigmas)
    assert back.places.tolist() == fixes.places.tolist() and back.stamps_ns.tolist() == [5]
    message = navsat_message(Fixes.of([5], [[48.1, 11.5, 520.0]]), 0)
    assert np.isnan(fix_of(message).sigmas).all()
    message.status.status = -1
    assert np.isnan(fix_of(message).places).all()


def test_a_recording_without_a_receiver_says_what_to_give(tmp_path: Path) -> None:
    simulate("room", tmp_path / "walk.mcap", duration_s=0.5, every_block=90)
    with pytest.raises(HemislamError, match="; give a file of fixes"):
        recorded_fixes(tmp_path / "walk.mcap")


@pytest.mark.parametrize("text", ["noise", "noise=x", "colour=1", "rate=0", "outliers=2", "offset=1e12"])
def test_a_receiver_that_cannot_be_is_refused(text: str) -> None:
    with pytest.raises(HemislamError):
        Gnss().with_sizes([text])
