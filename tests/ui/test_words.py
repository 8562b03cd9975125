"""The texts of the panels, and their plots.

Tests app/ui/files.py, app/ui/readouts.py, app/ui/status.py, app/ui/hints.py.
"""

import re
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
import viser

from app.sensors.findings import Finding
from app.sensors.live.status import LiveState
from app.sensors.presets import PRESETS
from app.server.protocol import (
    Notice,
    Snapshot,
    StepFrame,
    Transport,
)
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import STAGES
from app.ui import hints
from app.ui.colours import LABEL, Limits, legend
from app.ui.files import _FORMATS, folder_name, result_folder_name, size_text
from app.ui.hints import HINTS
from app.ui.html import BAD, GOOD, WARN, Tile, panel, source
from app.ui.loops.words import KINDS, LoopKind
from app.ui.readouts import HISTORY, filter_tiles, plotted, stacked_stages, times_html
from app.ui.status import DoctorPanel, findings_html, log_html, settled, title, verdicts
from app.ui.transport import where
from tests.ui.conftest import page_of
from tests.ui.fake_engine import FINDINGS, FakeEngine


def test_news_of_a_live_source_that_was_left_name_it_once() -> None:
    news = (Notice(1, "info", "Live: connected to foxglove://robot:8765.", "live"),)
    assert "Live: connected to" in log_html(news, "live")
    assert "live: connected to" in log_html(news, "walk.mcap")


def test_findings_that_need_the_user_come_first_with_their_option() -> None:
    text = findings_html(FINDINGS, Params())
    assert text.index("needs attention") < text.index("corrected") < text.index("fine")
    assert "<code>--set imu.max_gap=0.4</code>" in text
    assert verdicts(FINDINGS) == ("2 checks passed, 1 corrected, 1 needs attention", BAD)
    assert verdicts(FINDINGS[:1]) == ("1 check passed", GOOD) and verdicts(()) is None


def test_a_live_source_without_checks_has_no_heading_for_them(server: viser.ViserServer, engine: FakeEngine) -> None:
    doctor, recording = DoctorPanel(page_of(server)), engine.snapshot.recording
    assert recording is not None
    doctor.draw(engine.snapshot)
    assert "Checks of this recording" in doctor._html.content
    doctor.draw(replace(engine.snapshot, recording=replace(recording, findings=())))
    assert not doctor._html.content


def test_the_time_of_every_stage_has_its_unit() -> None:
    engine = FakeEngine(frames=2)
    engine.send(StepFrame())
    result = engine.snapshot.result
    assert result is not None
    shown = times_html(engine.snapshot, result)
    assert all(re.search(rf"{stage} [\d.–]+ ms", shown) for stage in STAGES)


@pytest.mark.parametrize(
    "render",
    [
        lambda text: findings_html((replace(FINDINGS[0], subject=text, text=text, option=text),), Params()),
        lambda text: log_html((Notice(1, "error", text),)),
        lambda text: panel("macros.tiles", [Tile(text, text, text, text)]),
        lambda text: title(Snapshot(recording=replace(FakeEngine(frames=2).snapshot.recording, path=Path(text)))),  # type: ignore[type-var]
    ],
)
def test_names_from_a_recording_are_never_markup(render: Callable[[str], str]) -> None:
    assert "<script" not in render("<script>alert(1)<")


def test_a_finding_is_settled_by_a_button_where_its_option_changes_a_parameter() -> None:
    gap = settled(Params(), "--set imu.max_gap=0.4")
    assert gap is not None and gap.imu.max_gap == 0.4
    assert settled(Params(), "--preset h2lid") == Params().merged(PRESETS["h2lid"])
    for beyond in ("", "--set 'sensor.translation=[x, y, z]'", "--lidar-topic /points", "--set 'x", "--preset nobody"):
        assert settled(Params(), beyond) is None
    assert findings_html(FINDINGS, Params()).count("settle --set imu.max_gap=0.4") == 1
    assert gap is not None and "settle --set imu" not in findings_html(FINDINGS, gap)


def test_a_finding_that_no_button_settles_says_where_its_option_belongs() -> None:
    topic = Finding("IMU values", "needs you", "the IMU is stuck", "--imu-topic if there is another IMU")
    shown = findings_html((topic,), Params())
    assert "Start hemislam with</span><code>--imu-topic if there is another IMU</code>" in shown
    assert topic.spoken == "the IMU is stuck; start hemislam with --imu-topic if there is another IMU"
    assert "Start hemislam with" not in findings_html(FINDINGS, Params())


def test_every_tile_is_explained_in_a_sentence() -> None:
    folder = Path(hints.__file__).parent
    sources = "".join(path.read_text() for path in folder.rglob("*.py") if path != Path(hints.__file__))
    named = set(re.findall(r'Tile\(\s*"([^"]+)"', sources))
    assert len(named) > 40 and named <= HINTS.keys()
    assert [name for name in HINTS if f'"{name}"' not in sources] == [], "a tile that has another name now has no hint"
    assert all(text.endswith(".") and ". " not in text for text in HINTS.values())


def test_a_live_run_waits_for_its_first_scan_and_asks_for_no_button() -> None:
    recorded = Snapshot(recording=FakeEngine(frames=2).snapshot.recording)
    assert "Press Play" in where(recorded)
    live = where(replace(recorded, live=LiveState(), transport=Transport(playing=True)))
    assert "first scan" in live and "Press" not in live


def test_the_legend_names_limits_and_unit() -> None:
    text = legend("height", Limits(-2.0, 3.0))
    assert ">-2<" in text and ">3<" in text and "height · m" in text
    assert "Choose the map to compare with" in legend("distance", None) and "Choose" not in legend("density", None)
    assert all(name in legend(LABEL, None) for name in ("ground", "not ground", "seed", "moving"))


def test_the_legend_shows_chosen_ends_where_they_lie_among_all_values() -> None:
    text = legend("height", Limits(-2.0, 3.0), Limits(-1.0, 2.0))
    assert ">-1<" in text and ">2<" in text
    assert 'value="20"' in text and 'value="80"' in text


@pytest.mark.parametrize("typed", ["", "  ", ".", "..", ".hidden", "a/b", "/tmp", "a\0b", "n" * 300, "ü" * 150])
def test_a_name_that_is_none_for_a_folder_is_refused(typed: str) -> None:
    with pytest.raises(HemislamError, match=r"needs a name|too long"):
        folder_name(typed)
    assert folder_name(" hall 2.5 ") == "hall 2.5"


def test_result_folders_sort_and_need_no_quoting() -> None:
    now = datetime(2026, 5, 1, 13, 45, 2)
    assert result_folder_name(Path("/x/hall bpearl (1).mcap"), now) == "hall_bpearl__1_-2026-05-01-134502"
    long = result_folder_name(Path(f"/x/{'ö' * 120}.mcap"), now)
    assert folder_name(long) == long and long.endswith("ö-2026-05-01-134502")


@pytest.mark.parametrize(
    ("size", "text"), [(12, "12 B"), (2_000, "2 kB"), (25_400_000, "25 MB"), (3_800_000_000, "3.8 GB")]
)
def test_sizes_read_as_people_say_them(size: int, text: str) -> None:
    assert size_text(size) == text


def test_plots_show_the_newest_frames_only(engine: FakeEngine) -> None:
    engine.send(StepFrame(HISTORY + 20))
    stamps, planarity = plotted(engine.snapshot.series, "planarity")
    assert len(stamps) == len(planarity) == HISTORY
    assert stamps[-1] == pytest.approx(0.1 * (HISTORY + 19))


def test_plots_of_all_frames_keep_every_peak_and_cover_the_whole_trajectory() -> None:
    count = 4 * HISTORY + 7
    error = np.full(count, np.nan)  # not known for most frames
    error[[5, 900]] = 3.0, 2.0
    series = {"stamp_s": np.arange(count) * 0.1, "error_m": error, "total_ms": np.full(count, 9.0)}
    stamps, errors, total = plotted(series, "error_m", "total_ms", worst="error_m")
    assert len(stamps) == HISTORY and (np.diff(stamps) > 0).all()
    assert stamps[0] < 0.5 and stamps[-1] > 0.1 * (count - 5)
    known = np.isfinite(errors)
    assert errors[known].tolist() == [3.0, 2.0] and stamps[known].tolist() == pytest.approx([0.5, 90.0])
    assert (total == 9.0).all()


def test_stages_are_stacked_to_the_total(engine: FakeEngine) -> None:
    engine.send(StepFrame(10))
    _, highest, *lower = stacked_stages(engine.snapshot.series)
    assert np.allclose(highest, engine.snapshot.series["total_ms"])
    assert all((a >= b).all() for a, b in zip([highest, *lower], lower, strict=False))


def test_the_workbench_offers_each_file_of_the_table_of_formats() -> None:
    offered = " ".join(_FORMATS)
    assert all(name in offered for name in ("trajectory.csv", "trajectory.gpx", "map.kmz", "map.laz"))


def luminance(rgb: np.ndarray) -> float:
    """Relative, as WCAG 2.2 defines it."""
    share = rgb / 255
    return float(np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4) @ (0.2126, 0.7152, 0.0722))


@pytest.mark.parametrize(("sheet", "background"), [("style.css", 255.0), ("viser_adapter.css", 36.0)])
@pytest.mark.parametrize("kind", KINDS.values(), ids=lambda kind: kind.name)
def test_verdicts_are_readable_also_in_a_row_that_is_chosen(sheet: str, background: float, kind: LoopKind) -> None:
    text = re.search(r"--hs-text:#(\w{6})", source(sheet))
    share = re.search(r"--hs-share:(\d+)%", source(sheet))
    assert text and share
    colour = np.array(kind.colour) * int(share[1]) / 100
    colour += np.array([int(text[1][i : i + 2], 16) for i in (0, 2, 4)]) * (1 - int(share[1]) / 100)
    chosen = 0.35 * np.array([38.0, 166.0, 154.0]) + 0.65 * background
    dark, light = sorted((luminance(colour), luminance(chosen)))
    assert (light + 0.05) / (dark + 0.05) >= 4.5


@pytest.mark.parametrize(
    ("information", "words"),
    [((1 / 0.04**2,), ("4.0", "cm", "")), ((2.7e-13,), ("> 10 m", "", WARN)), ((), ("–", "cm", WARN))],
)
def test_degeneracy_is_said_as_the_diagnostics_say_it(information: tuple[float, ...], words: tuple[str, ...]) -> None:
    result = FakeEngine(columns=8).result(20, Params())
    update = replace(result.registration, eigenvalues=np.array(information), degenerate=bool(words[2]))
    (tile,) = (tile for tile in filter_tiles(replace(result, registration=update)) if tile.name == "degeneracy")
    assert (tile.value, tile.unit, tile.colour) == words
