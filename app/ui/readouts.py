"""What the newest frame measured: tiles for now, plots of the last few hundred frames or of all."""

from typing import Any, Final

import numpy as np
import viser

from app.server.protocol import Snapshot
from app.slam.types import F64, I64, STAGES, StepResult
from app.ui.colours import Rgb
from app.ui.html import BAD, GOOD, WARN, css, dot, heading, number, tile, tiles

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


def ground_tiles(result: StepResult, limit: float) -> str:
    """Ground segmentation of the newest frame."""
    ground = result.ground
    flat = ground.found and ground.planarity < limit
    return tiles(
        (
            tile("λ3/λ2", number(ground.planarity, 3), f"< {limit:g}", colour=GOOD if flat else BAD),
            tile("seeds", f"{ground.seeds:,}"),
            tile("ground", number(100 * ground.share, 1), "%"),
            tile(
                "points: scan → ground thinned → filter",
                f"{result.points_in:,} → {result.points_reduced:,} → {result.points_filter:,}",
                note=ground.reason,
                width="wide",
            ),
        )
    )


def filter_tiles(result: StepResult) -> str:
    """How the filter's update went."""
    update = result.registration
    share = update.inliers / update.used if update.used else np.nan
    smallest = float(update.eigenvalues[0]) if len(update.eigenvalues) else np.nan
    information = f"least information {smallest:.3g}" if np.isfinite(smallest) else ""
    return tiles(
        (
            tile("iterations", str(update.iterations), "" if update.converged else "not conv.",
                 colour="" if update.converged else WARN),
            tile("residual", number(1000 * update.residual_rms, 1), "mm"),
            tile("inliers", number(100 * share, 0), f"% of {update.used:,}"),
            tile(
                "degeneracy",
                "degenerate" if update.degenerate else "none",
                information,
                colour=WARN if update.degenerate else "",
                note=update.reason,
                width="wide",
            ),
        )
    )  # fmt: skip


def state_tiles(snapshot: Snapshot, result: StepResult) -> str:
    """Motion, biases and the error to truth."""
    state, series = result.state, snapshot.series
    speed = float(np.linalg.norm(state.v_odom_imu))
    gyro, accel = 1000 * state.b_gyro, 1000 * state.b_accel
    parts = [
        tile("velocity", number(speed), "m/s", note=_vector(state.v_odom_imu, 2), width="half"),
        tile("walked", number(_last(series, "distance"), 1), "m", width="half"),
        tile("gyroscope bias", number(float(np.linalg.norm(gyro))), "mrad/s", note=_vector(gyro, 2), width="half"),
        tile(
            "acceleration bias", number(float(np.linalg.norm(accel)), 1), "mm/s²", note=_vector(accel, 1), width="half"
        ),
    ]
    errors = series.get("error_m", np.empty(0))
    if np.isfinite(errors).any():
        rms = float(np.sqrt(np.nanmean(errors**2)))
        parts.append(
            tile(
                "position error to truth",
                number(100 * float(errors[-1]), 1),
                f"cm · RMS {100 * rms:.1f} cm",
                width="wide",
            )
        )
    return tiles(parts)


def time_tiles(snapshot: Snapshot, result: StepResult) -> str:
    """Milliseconds per stage, as the legend of the plot below."""
    total = result.timings_ms.get("total", float("nan"))
    stages = "".join(
        dot(STAGE_COLOURS[stage], f"{stage} {number(result.timings_ms.get(stage, float('nan')), 1)}")
        for stage in STAGES
    )
    return (
        tiles(
            (
                tile("frame", number(total, 1), "ms"),
                tile("dropped", f"{snapshot.transport.dropped:,}", "scans"),
            )
        )
        + f'<div class="hs"><div class="hs-keys hs-note">{stages}</div></div>'
    )


def _last(series: dict[str, F64], name: str) -> float:
    values = series.get(name)
    return float(values[-1]) if values is not None and len(values) else float("nan")


def _vector(v: F64, digits: int) -> str:
    return "  ".join(f"{component:+.{digits}f}" for component in v)


def recent(series: dict[str, F64], *names: str) -> tuple[F64, ...]:
    """The last `HISTORY` values of series, and of `stamp_s` first; one zero each before the first frame."""
    return _chosen(series, slice(-HISTORY, None), names)


def worst(series: dict[str, F64], by: str, *names: str) -> tuple[F64, ...]:
    """As `recent`, but of all frames: `HISTORY` that are spread evenly, each the one of its part with the most `by`."""
    count = len(series.get("stamp_s", ()))
    if count <= HISTORY:
        return recent(series, *names)
    starts = np.arange(HISTORY + 1) * count // HISTORY
    part = np.repeat(np.arange(HISTORY), np.diff(starts))
    order = np.lexsort((np.nan_to_num(series[by], nan=-np.inf), part))
    return _chosen(series, order[starts[1:] - 1], names)


def _chosen(series: dict[str, F64], frames: slice | I64, names: tuple[str, ...]) -> tuple[F64, ...]:
    if not len(series.get("stamp_s", ())):
        return tuple(np.zeros(1) for _ in range(1 + len(names)))
    return tuple(series[name][frames] for name in ("stamp_s", *names))


def stacked_stages(series: dict[str, F64], *, whole: bool = False) -> tuple[F64, ...]:
    """Stamps, then running sums of the stages' milliseconds from the highest down, for filled areas.

    Peaks are cut at four times the median: the first frame's would leave nothing of all others.
    """
    names = [f"{stage}_ms" for stage in STAGES]
    stamps, *stages = worst(series, "total_ms", *names) if whole else recent(series, *names)
    sums = np.cumsum(np.nan_to_num(np.array(stages)), axis=0)
    sums = np.minimum(sums, 4 * np.median(sums[-1]))
    return (stamps, *sums[::-1])


class ReadoutPanel:
    """Tiles and plots in the caller's container."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._tiles = gui.add_html("")
        self._time = gui.add_html("")
        layers = [(css(STAGE_COLOURS[stage]), 0.0, css(STAGE_COLOURS[stage])) for stage in reversed(STAGES)]
        self._whole = gui.add_checkbox(
            "all frames", False, hint="In the plots. Where frames share a place, the worst is drawn. Else the last 300."
        )
        self._drawn_whole = False
        gui.add_html(heading("Frame time by stage, ms (peaks cut)"))
        self._stages = plot(gui, stacked_stages({}), layers)
        gui.add_html(heading("λ3/λ2 of the seeds and its limit"))
        self._planarity = plot(
            gui, (*recent({}, "planarity"), np.zeros(1)), [("#3ecf9a", 1.5, ""), ("#ff6b6b", 1.0, "")]
        )
        gui.add_html(heading("Residual (RMS), mm"))
        self._residual = plot(gui, recent({}, "residual_rms"), [("#40b8f0", 1.5, "")])
        self._error_title = gui.add_html(heading("Position error to truth, cm"), visible=False)
        self._error = plot(gui, recent({}, "error_m"), [("#ff5c8d", 1.5, "")])
        self._error.visible = False

    @property
    def stale(self) -> bool:
        """Whether the plots are to be drawn otherwise than they are."""
        return self._whole.value != self._drawn_whole

    def draw(self, snapshot: Snapshot) -> None:
        """Show the snapshot's numbers. Called a few times a second at most: they are not read faster."""
        result = snapshot.result
        if result is None:
            self._tiles.content = '<div class="hs hs-quiet">Numbers appear with the first frame.</div>'
            self._time.content = ""
        else:
            limit = snapshot.params.ground.planarity
            self._tiles.content = (
                heading("Ground")
                + ground_tiles(result, limit)
                + heading("Filter")
                + filter_tiles(result)
                + heading("Motion")
                + state_tiles(snapshot, result)
                + heading("Time")
            )
            self._time.content = time_tiles(snapshot, result)

    def draw_plots(self, snapshot: Snapshot) -> None:
        """Show the snapshot's plots, of which a browser draws each point anew."""
        series = snapshot.series
        whole = self._drawn_whole = self._whole.value

        def curve(name: str) -> tuple[F64, ...]:
            return worst(series, name, name) if whole else recent(series, name)

        self._stages.data = stacked_stages(series, whole=whole)
        stamps, planarity = curve("planarity")
        self._planarity.data = (stamps, planarity, np.full(len(stamps), snapshot.params.ground.planarity))
        stamps, residual = curve("residual_rms")
        self._residual.data = (stamps, 1000 * residual)
        stamps, error = curve("error_m")
        self._error.visible = self._error_title.visible = bool(np.isfinite(error).any() and len(error) > 1)
        self._error.data = (stamps, 100 * error)


def plot(gui: viser.GuiApi, data: tuple[F64, ...], looks: list[tuple[str, float, str]]) -> viser.GuiUplotHandle:
    """A small chart over seconds; per line its colour, width and fill ("" for none)."""
    lines: list[Any] = [{"label": "s"}]
    for colour, width, fill in looks:
        lines.append({"stroke": colour, "width": width, "points": {"show": False}, **({"fill": fill} if fill else {})})
    axes: Any = tuple({"font": "10px sans-serif", "ticks": {"size": 3}, "gap": 2, "size": size} for size in (22, 38))
    return gui.add_uplot(
        data,
        tuple(lines),
        scales={"x": {"time": False}},
        axes=axes,
        legend={"show": False},
        cursor={"show": False},
        height=110,
        padding=(6, 10, 0, 0),
    )
