"""Measurements of the newest frame as tiles, and of the last few hundred frames, or of all, as plots."""

from typing import Any, Final

import numpy as np
import viser

from app.server.protocol import Snapshot
from app.slam.types import F64, I64, STAGES, StepResult
from app.ui.colours import Rgb
from app.ui.html import BAD, GOOD, WARN, Tile, css, heading, number, panel
from app.ui.timeline import OPEN, OPEN_CM, uncertainty_cm
from app.ui.widgets import PANEL_PERIOD_S, Changes, Page, chart

HISTORY: Final = 300
"""Most frames in a plot."""

STAGE_COLOURS: Final[dict[str, Rgb]] = {
    "propagate": (99, 132, 255),
    "deskew": (64, 184, 240),
    "ground": (46, 190, 165),
    "downsample": (152, 205, 90),
    "update": (255, 176, 32),
    "insert": (255, 120, 92),
    "keyframe": (206, 112, 220),
    "loops": (150, 150, 165),
}


def ground_tiles(result: StepResult, limit: float) -> list[Tile]:
    ground = result.ground
    flat = ground.found and ground.planarity < limit
    counts = f"{result.points_in:,} → {result.points_reduced:,} → {result.points_filter:,}"
    return [
        Tile("λ3/λ2", number(ground.planarity, 3), f"< {limit:g}", colour=GOOD if flat else BAD),
        Tile("seeds", f"{ground.seeds:,}"),
        Tile("ground", number(100 * ground.share, 1), "%"),
        Tile("points: scan → ground thinned → filter", counts, "", ground.reason, width="wide"),
    ]


def filter_tiles(result: StepResult) -> list[Tile]:
    update = result.registration
    share = update.inliers / update.used if update.used else np.nan
    uncertainty = float(uncertainty_cm(update.eigenvalues[0])) if len(update.eigenvalues) else np.nan
    degeneracy = (OPEN, "") if uncertainty >= OPEN_CM else (number(uncertainty, 1), "cm")
    converged = ("", "") if update.converged else ("not conv.", WARN)
    return [
        Tile("iterations", str(update.iterations), converged[0], colour=converged[1]),
        Tile("residual", number(1000 * update.residual_rms, 1), "mm"),
        Tile("inliers", number(100 * share, 0), f"% of {update.used:,}"),
        Tile("degeneracy", *degeneracy, update.reason, WARN if update.degenerate else "", "wide"),
    ]


def state_tiles(snapshot: Snapshot, result: StepResult) -> list[Tile]:
    state, series = result.state, snapshot.series
    speed = float(np.linalg.norm(state.v_odom_imu))
    walked = float(series["distance"][-1]) if len(series["distance"]) else np.nan
    gyro, accel = 1000 * state.b_gyro, 1000 * state.b_accel
    gyro_norm, accel_norm = number(float(np.linalg.norm(gyro))), number(float(np.linalg.norm(accel)), 1)
    tiles = [
        Tile("velocity", number(speed), "m/s", _vector(state.v_odom_imu, 2), width="half"),
        Tile("distance", number(walked, 1), "m", width="half"),
        Tile("gyroscope bias", gyro_norm, "mrad/s", _vector(gyro, 2), width="half"),
        Tile("acceleration bias", accel_norm, "mm/s²", _vector(accel, 1), width="half"),
    ]
    if len(known := series["error_m"][np.isfinite(series["error_m"])]):
        rms = f"cm · RMS {100 * float(np.sqrt(np.mean(known**2))):.1f} cm"
        tiles.append(Tile("position error to truth", number(100 * float(known[-1]), 1), rms, width="wide"))
    return tiles


def times_html(snapshot: Snapshot, result: StepResult) -> str:
    """Milliseconds per stage; also the legend of the plot below."""
    took = result.timings_ms
    tiles = [
        Tile("frame", number(took.get("total", np.nan), 1), "ms"),
        Tile("dropped", f"{snapshot.transport.dropped:,}", "scans"),
    ]
    stages = [(STAGE_COLOURS[stage], f"{stage} {number(took.get(stage, np.nan), 1)} ms") for stage in STAGES]
    return panel("times", tiles, stages)


def _vector(v: F64, digits: int) -> str:
    return "  ".join(f"{component:+.{digits}f}" for component in v)


def plotted(series: dict[str, F64], *names: str, worst: str = "") -> tuple[F64, ...]:
    """Stamps and series for a plot of at most `HISTORY` frames; before the first frame, a single zero each.

    Args:
        worst: "" for the newest frames; a series name: all frames in `HISTORY` parts, and from each part the frame
            with the greatest value of that series.
    """
    count = len(series["stamp_s"])
    if not count:
        return (np.zeros(1),) * (1 + len(names))
    frames: slice | I64 = slice(-HISTORY, None)
    if worst and count > HISTORY:
        starts = np.arange(HISTORY + 1) * count // HISTORY
        part = np.repeat(np.arange(HISTORY), np.diff(starts))
        frames = np.lexsort((np.nan_to_num(series[worst], nan=-np.inf), part))[starts[1:] - 1]
    return tuple(series[name][frames] for name in ("stamp_s", *names))


def stacked_stages(series: dict[str, F64], worst: str = "") -> tuple[F64, ...]:
    """As `plotted`: stamps, then cumulative sums of the stages' milliseconds, largest first, for filled areas.

    Peaks are cut at four times the median: those of the first frames would flatten the rest.
    """
    stamps, *stages = plotted(series, *(f"{stage}_ms" for stage in STAGES), worst=worst)
    sums = np.cumsum(np.nan_to_num(np.array(stages)), axis=0)
    sums = np.minimum(sums, 4 * np.median(sums[-1]))
    return (stamps, *sums[::-1])


class ReadoutPanel:
    """Tiles and plots in the caller's container."""

    def __init__(self, page: Page) -> None:
        gui = page.gui
        self._changes = Changes(page.now, PANEL_PERIOD_S)
        self._tiles = gui.add_html("")
        self._plots = gui.add_folder(None, visible=False)
        with self._plots:
            self._add_plots(gui)

    def _add_plots(self, gui: viser.GuiApi) -> None:
        colours = [css(STAGE_COLOURS[stage]) for stage in reversed(STAGES)]
        self._whole = gui.add_checkbox(
            "all frames",
            False,
            hint="Plot all frames; where several share a pixel, the worst is drawn. Off: the last 300.",
        )
        gui.add_html(heading("Frame time by stage, ms (peaks cut)"))
        layers = [{"stroke": colour, "width": 0, "fill": colour} for colour in colours]
        self._stages = chart(gui, layers)
        gui.add_html(heading("λ3/λ2 of the seeds and its limit"))
        limit: dict[str, Any] = {"stroke": "#ff6b6b", "width": 1.0}
        self._planarity = chart(gui, [{"stroke": "#3ecf9a", "width": 1.5}, limit])
        gui.add_html(heading("Residual (RMS), mm"))
        self._residual = chart(gui, [{"stroke": "#40b8f0", "width": 1.5}])
        self._of_truth = gui.add_folder(None, visible=False)
        with self._of_truth:
            gui.add_html(heading("Position error to truth, cm"))
            self._error = chart(gui, [{"stroke": "#ff5c8d", "width": 1.5}])

    def draw(self, snapshot: Snapshot) -> None:
        dropped = snapshot.transport.dropped
        if not self._changes(snapshot.result, snapshot.series, snapshot.params, dropped, self._whole.value):
            return
        result = snapshot.result
        self._plots.visible = result is not None
        if result is None:
            self._tiles.content = panel("quiet", "Press Play or Step below: numbers appear with the first frame.")
        else:
            sections = [
                ("Ground", ground_tiles(result, snapshot.params.ground.planarity)),
                ("Filter", filter_tiles(result)),
                ("Motion", state_tiles(snapshot, result)),
            ]
            self._tiles.content = panel("readouts", sections) + times_html(snapshot, result)
        series, whole = snapshot.series, self._whole.value
        self._stages.data = stacked_stages(series, "total_ms" if whole else "")
        stamps, planarity = plotted(series, "planarity", worst="planarity" if whole else "")
        self._planarity.data = (stamps, planarity, np.full(len(stamps), snapshot.params.ground.planarity))
        stamps, residual = plotted(series, "residual_rms", worst="residual_rms" if whole else "")
        self._residual.data = (stamps, 1000 * residual)
        stamps, error = plotted(series, "error_m", worst="error_m" if whole else "")
        self._of_truth.visible = bool(np.isfinite(error).any() and len(error) > 1)
        self._error.data = (stamps, 100 * error)
