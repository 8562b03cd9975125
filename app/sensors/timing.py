"""When each point was measured: which field says it, in which unit, counted from what.

A wrong answer here does not crash anything; it bends every scan and drifts silently. So each choice
is checked against what must hold: a scan lasts about as long as the next one is away, and no point
was measured after its message was logged.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from app.sensors.findings import Finding
from app.slam.params import RecordingParams

TIME_NAMES = ("timestamp", "time", "t", "offset_time", "time_stamp", "timeoffset", "time_offset", "stamp", "ts")
UNITS_NS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}

Anchor = Literal["absolute", "header", "first", "last"]


@dataclass(frozen=True, slots=True)
class Clocked:
    """What one probed cloud says of time: log time and header stamp, and its points' time columns.

    Attributes:
        log_ns, stamp_ns: of the message. columns: field -> (n,) values of the valid points.
        stamped: False if the header carries no time, and `stamp_ns` is the log time.
    """

    log_ns: int
    stamp_ns: int
    columns: dict[str, npt.NDArray[Any]]
    stamped: bool = True


@dataclass(frozen=True, slots=True)
class Timing:
    """The decision, as `CloudLayout` wants it. field: None if the azimuth must tell the time.

    Attributes:
        period_ns: between scans.
    """

    field: str | None
    unit_ns: int
    anchor: Anchor
    shift_ns: int
    period_ns: int


def settle_timing(clouds: list[Clocked], chosen: RecordingParams) -> tuple[Timing, list[Finding]]:
    """Decide from a few clouds. Bad choices of the user are findings, not errors."""
    period_ns, period_known = scan_period_ns(clouds, chosen.rotation_rate)
    rejected: list[str] = []
    for name in _candidates(clouds, chosen.time_field):
        timing, problem, findings = _try_field(name, clouds, chosen, period_ns)
        if not problem or chosen.time_field == name:
            return timing, findings
        rejected.append(problem)
    return _without_field(clouds, chosen, period_ns, period_known, rejected)


def scan_period_ns(clouds: list[Clocked], rotation_rate: float) -> tuple[int, bool]:
    """Time between scans, and whether it was measured (else: of `rotation_rate`, or 0.1 s)."""
    for times in ([c.stamp_ns for c in clouds], [c.log_ns for c in clouds]):
        steps = np.diff(np.array(times, np.int64))
        steps = steps[steps > 1_000_000]
        if len(steps):
            return int(np.median(steps)), True
    return round(1e9 / (rotation_rate or 10.0)), False


def _candidates(clouds: list[Clocked], wanted: str) -> list[str]:
    columns = clouds[0].columns
    if wanted == "none":
        return []
    if wanted != "auto":
        return [wanted]
    lower = {name.lower(): name for name in columns}
    usual = [lower[name] for name in TIME_NAMES if name in lower]
    return usual + [name for low, name in lower.items() if may_be_time(low) and name not in usual]


def may_be_time(name: str) -> bool:
    """Whether a field may be the points' time, by its name."""
    return name.lower() in TIME_NAMES or "time" in name.lower() or "stamp" in name.lower()


def _try_field(
    name: str, clouds: list[Clocked], chosen: RecordingParams, period_ns: int
) -> tuple[Timing, str, list[Finding]]:
    """Timing by this field; a problem, if it can not be the time of the points; the findings.

    A unit that was chosen is kept even where it does not fit; then it is a finding, not a problem.
    """
    columns = [cloud.columns[name] for cloud in clouds]
    spans = [float(column.max()) - float(column.min()) for column in columns]
    span = float(np.median(spans))
    kind = str(columns[0].dtype)
    problem = ""
    if columns[0].dtype == np.float32 and columns[0].any() and _spacing(columns[0]) > 0.02 * span:
        problem = f"`{name}` is float32, too coarse for values like {float(columns[0].max()):.0f}"
    elif span <= 0.0:
        problem = f"`{name}` is the same for all points of a scan"
    if chosen.time_unit == "auto":
        unit = min(UNITS_NS, key=lambda u: abs(np.log(max(span, 1e-12) * UNITS_NS[u] / period_ns)))
    else:
        unit = chosen.time_unit
    unit_ns = UNITS_NS[unit]
    ratio = span * unit_ns / period_ns
    seconds = span * unit_ns / 1e9
    fits = 0.05 < ratio < 1.5
    misfit = f"`{name}` in {unit} makes a scan last {seconds:.3g} s, yet they come every {period_ns / 1e9:.3f} s"
    if not problem and not fits and chosen.time_unit == "auto":
        problem = misfit
    facts = (
        f"`{name}` ({kind}) in {unit}: a scan then lasts {seconds:.4f} s and they come every {period_ns / 1e9:.4f} s"
    )
    if problem:
        finding = Finding("point time", "needs you", problem, "--set recording.time_field=none")
    elif not fits:
        finding = Finding("point time", "needs you", misfit, "--set recording.time_unit=auto")
    elif chosen.time_unit != "auto":
        finding = Finding("point time", "fine", f"{facts}, as you set it")
    else:
        finding = Finding("point time", "fine", facts, f"--set recording.time_unit={unit}")
    timing, reference = _reference(name, unit_ns, columns, clouds, chosen, period_ns)
    return timing, problem, [finding, *reference]


def _reference(
    name: str,
    unit_ns: int,
    columns: list[npt.NDArray[Any]],
    clouds: list[Clocked],
    chosen: RecordingParams,
    period_ns: int,
) -> tuple[Timing, list[Finding]]:
    """What the field counts from, and which point the header belongs to."""
    # Python integers: nanoseconds since 1970 do not fit a float exactly.
    least = [_to_ns(column.min(), unit_ns) for column in columns]
    most = [_to_ns(column.max(), unit_ns) for column in columns]
    stamps = [cloud.stamp_ns for cloud in clouds]
    to_first = float(np.median([s - t for s, t in zip(stamps, least, strict=True)]))
    to_last = float(np.median([s - t for s, t in zip(stamps, most, strict=True)]))
    near = min(abs(to_first), abs(to_last)) < max(2e9, 3 * period_ns)
    # A clock that starts at zero (a simulator's) is small at first, but it runs on with the headers.
    elapsed = stamps[-1] - stamps[0]
    runs_on = elapsed > 0 and abs(least[-1] - least[0] - elapsed) < 0.5 * elapsed
    small = max(abs(min(least)), abs(max(most))) < 3 * period_ns and not runs_on
    if chosen.time_reference == "absolute" or (chosen.time_reference == "auto" and near and not small):
        timing = Timing(name, unit_ns, "absolute", 0, period_ns)
        return timing, _absolute_findings(to_first, to_last, period_ns, chosen, near)
    if small:
        header, evidence, verdict = _header_of(clouds, least, most, period_ns, chosen)
        shift = 0
        if header == "first" and min(least) < -0.1 * period_ns:
            shift = -min(least)
        elif header == "last" and max(most) > 0.1 * period_ns:
            shift = -max(most)
        reference = Finding("time reference", "fine", f"`{name}` counts from the header stamp (it stays below a scan)")
        timing = Timing(name, unit_ns, "header", shift, period_ns)
    else:
        header, evidence, verdict = _header_of(clouds, least, most, period_ns, chosen)
        away = min((to_first, to_last), key=abs) / 1e9
        reference = Finding(
            "time reference",
            "corrected",
            f"`{name}` runs on a clock of its own, {abs(away):.3f} s {'behind' if away > 0 else 'ahead of'} the header"
            f" stamp; each scan's {header} point was put at its header stamp",
            "--set recording.time_reference=absolute",
        )
        timing = Timing(name, unit_ns, header, 0, period_ns)
    other = "first" if header == "last" else "last"
    return timing, [
        reference,
        Finding("header stamp", verdict, f"of the {header} point: {evidence}", f"--set recording.header_stamp={other}"),
    ]


def _absolute_findings(
    to_first: float, to_last: float, period_ns: int, chosen: RecordingParams, near: bool
) -> list[Finding]:
    header, offset = ("first", to_first) if abs(to_first) < abs(to_last) else ("last", to_last)
    if not near:
        text = f"taken as absolute, as you set it, yet {abs(offset) / 1e9:.1f} s from the header stamps"
        return [Finding("time reference", "needs you", text, "--set recording.time_reference=auto")]
    findings = [Finding("time reference", "fine", "absolute: it agrees with the header stamps")]
    if abs(offset) < 0.3 * period_ns:
        text = f"of the {header} point, to {abs(offset) / 1e6:.1f} ms; the points' own times are used"
        if chosen.header_stamp not in ("auto", header):
            text += f", so `{chosen.header_stamp}` as you set it has no effect"
        findings.append(Finding("header stamp", "fine", text))
    else:
        text = f"{offset / 1e9:+.3f} s from the {header} point; the points' own times are used"
        findings.append(Finding("header stamp", "corrected", text, "--set recording.time_reference=relative"))
    return findings


def _header_of(
    clouds: list[Clocked], least: list[int], most: list[int], period_ns: int, chosen: RecordingParams
) -> tuple[Literal["first", "last"], str, Literal["fine", "corrected", "needs you"]]:
    """Which point the header belongs to, why, and how sure that is."""
    if chosen.header_stamp != "auto":
        return chosen.header_stamp, "as you set it", "fine"
    duration = float(np.median([m - i for i, m in zip(least, most, strict=True)]))
    if max(abs(min(least)), abs(max(most))) < 3 * period_ns:
        if max(most) < 0.1 * period_ns:
            return "last", "the points' times are negative, before it", "fine"
        delay = log_delay_ns(clouds)
        if delay is not None and delay < 0.5 * duration:
            text = (
                f"the clouds were logged {delay / 1e6:.0f} ms after it, "
                f"when a scan of {duration / 1e6:.0f} ms that began there could not be over"
            )
            return "last", text, "corrected"
        return "first", "the points' times count up from it", "fine"
    return header_by_delay(clouds, duration)


def header_by_delay(
    clouds: list[Clocked], duration_ns: float
) -> tuple[Literal["first", "last"], str, Literal["fine", "corrected", "needs you"]]:
    """The header's point by how long after it the clouds were logged; without evidence: the last."""
    delay = log_delay_ns(clouds)
    if delay is None:
        return "last", "nothing in the recording tells, so as most drivers do by default", "needs you"
    text = f"the clouds were logged {delay / 1e6:.0f} ms after it, and a scan takes {duration_ns / 1e6:.0f} ms"
    if delay < 0.5 * duration_ns:
        return "last", text, "corrected"
    if 0.9 * duration_ns < delay < 3 * duration_ns:
        return "first", text, "corrected"
    return "last", f"{text}, which does not tell, so as most drivers do by default", "needs you"


def log_delay_ns(clouds: list[Clocked]) -> float | None:
    """Median of log time minus header stamp; None if it is no evidence (equal, or other clocks)."""
    if not clouds[0].stamped:
        return 0.0
    delays = np.array([cloud.log_ns - cloud.stamp_ns for cloud in clouds], np.float64)
    delay = float(np.median(delays))
    if np.all(np.abs(delays) < 2_000) or not -1e6 < delay < 5e9:
        return None  # the writer copied the stamp, or the clocks have nothing to do with each other
    return delay


def _without_field(
    clouds: list[Clocked], chosen: RecordingParams, period_ns: int, period_known: bool, rejected: list[str]
) -> tuple[Timing, list[Finding]]:
    if chosen.rotation_rate > 0:
        period_ns = round(1e9 / chosen.rotation_rate)
        rate = f"{chosen.rotation_rate:g} revolutions per second, as you set it"
    elif period_known:
        rate = f"{1e9 / period_ns:.3g} revolutions per second, the rate of the clouds"
    else:
        rate = "10 revolutions per second, assumed"
    why = "; ".join(rejected) or ("as you set it" if chosen.time_field == "none" else "the clouds have no time field")
    measured, known = scan_period_ns(clouds, 0.0)
    agrees = not known or 0.9 < period_ns / measured < 1.1
    text = f"derived from the azimuth at {rate} ({why}); times recorded by the driver would be better"
    if not agrees:
        text += f"; but clouds come every {measured / 1e9:.3f} s"
    findings = [
        Finding(
            "point time", "corrected" if agrees and known else "needs you", text, "--set recording.rotation_rate=10"
        )
    ]
    if chosen.header_stamp == "auto":
        header, evidence, verdict = header_by_delay(clouds, period_ns)
    else:
        header, evidence, verdict = chosen.header_stamp, "as you set it", "fine"
    other = "first" if header == "last" else "last"
    findings.append(
        Finding("header stamp", verdict, f"of the {header} point: {evidence}", f"--set recording.header_stamp={other}")
    )
    return Timing(None, 1, "header", -period_ns if header == "last" else 0, period_ns), findings


def _spacing(column: npt.NDArray[Any]) -> float:
    """Distance between neighbouring numbers of this type at the largest value."""
    return float(np.spacing(np.abs(column).max()))


def _to_ns(value: Any, unit_ns: int) -> int:
    if isinstance(value, np.integer):
        return int(value) * unit_ns
    whole = int(np.floor(value))
    return whole * unit_ns + round((float(value) - whole) * unit_ns)
