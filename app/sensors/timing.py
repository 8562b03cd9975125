"""When each point was measured: the field of its time, the unit, and the moment from which it counts.

A wrong answer here does not crash anything; it bends every scan, and the map drifts silently. So each choice is checked
against two facts: a scan lasts about as long as the interval to the next one, and no point was measured after its
message was logged.
"""

import re
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from app.sensors.cloud_types import JOINED, CloudType, Probe
from app.sensors.findings import Finding, FindingVerdict
from app.slam.sections import RecordingParams
from app.slam.types import I64

LONGEST = 5.0
"""Most intervals that a scan may last: over one if several LiDARs send on one topic, which `clocks.py` reports."""
UNITS_NS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
MOST_NS = 2**61
"""Times more than 73 years after others are limited to this, so that integers can hold them."""
_SECONDS = ("sec", "s", "secs", "second", "seconds")
_NANOSECONDS = re.compile(rf"(.*?)(?:n|nano)(?:{'|'.join(_SECONDS)})")

Anchor = Literal["absolute", "header", "first", "last"]
End = Literal["first", "last"]


@dataclass(frozen=True, slots=True)
class Timing:
    """Where the points' times come from.

    Attributes:
        field: per-point time; None: derived from the azimuth. unit_ns: nanoseconds in one unit of it.
        anchor: "absolute": it is Unix time. "header": it counts from the header stamp plus `shift_ns`.
            "first"/"last": it counts from an unknown moment (the sensor's own clock), and the scan's
            earliest/latest point is at the header stamp.
        period_ns: between scans.
    """

    field: str | None
    unit_ns: int
    anchor: Anchor
    shift_ns: int
    period_ns: int


def settle_timing(clouds: list[Probe], kind: CloudType, chosen: RecordingParams) -> tuple[Timing, list[Finding]]:
    """Decide from a few clouds. Bad choices of the user are findings, not errors."""
    period_ns, period_known = scan_period_ns(clouds, chosen.rotation_rate)
    rejected: list[str] = []
    for name in _candidates(clouds[0], kind, chosen.time_field):
        timed = [probe for cloud in clouds if len((probe := replace(cloud, time=name)).points)]
        if not timed:
            rejected.append(f"`{name}` is not a finite number at any point")
            continue
        unit_ns, problem, finding = _settle_unit(name, timed, kind, chosen, period_ns)
        if not problem or chosen.time_field == name:
            timing, findings = _settle_reference(name, unit_ns, timed, chosen, period_ns)
            return timing, [finding, *findings]
        rejected.append(problem)
    return _without_field(clouds, chosen, period_ns, period_known, rejected)


def scan_period_ns(clouds: list[Probe], rotation_rate: float) -> tuple[int, bool]:
    """Time between scans, and whether it was measured (else it follows from `rotation_rate`, or is 0.1 s)."""
    for times in ([c.cloud.stamp_ns for c in clouds], [c.log_ns for c in clouds]):
        steps = np.diff(np.array(times, np.int64))
        steps = steps[steps > 1_000_000]
        if len(steps):
            return int(np.median(steps)), True
    return round(1e9 / (rotation_rate or 10.0)), False


def _candidates(probe: Probe, kind: CloudType, wanted: str) -> list[str]:
    if wanted == "none":
        return []
    if wanted != "auto":
        return [wanted]
    lower = {name.lower(): name for name in probe.cloud.fields}
    usual = [lower[name] for name in kind.times if name in lower]
    others = [lower[name] for name in lower if ("time" in name or "stamp" in name) and lower[name] not in usual]
    return [*_seconds_and_nanoseconds(probe, lower), *usual, *others]


def _seconds_and_nanoseconds(probe: Probe, lower: dict[str, str]) -> list[str]:
    """The joined names of two fields such as `timestampSec` and `timestampNsec`. lower: names by their lower case."""
    for name, nanoseconds in lower.items():
        if (found := _NANOSECONDS.fullmatch(name)) is None:
            continue
        seconds = next((lower[found[1] + unit] for unit in _SECONDS if found[1] + unit in lower), None)
        if seconds is None or any(probe.cloud.fields[one][1].kind not in "iu" for one in (seconds, nanoseconds)):
            continue
        if probe.column(nanoseconds).max() < 1_000_000_000:
            return [f"{seconds}{JOINED}{nanoseconds}"]
    return []


def _settle_unit(
    name: str, clouds: list[Probe], kind: CloudType, chosen: RecordingParams, period_ns: int
) -> tuple[int, str, Finding]:
    """ns in one unit of this field; why it cannot be the points' time, "" if it can; the finding.

    A unit that the user chose is kept even if it does not fit; this is then a finding, not a problem.
    """
    columns = [probe.column(name) for probe in clouds]
    first = columns[0]
    span = float(np.median([float(column.max()) - float(column.min()) for column in columns]))
    wanted = chosen.time_unit if chosen.time_unit != "auto" else kind.time_unit
    unit: str = wanted
    if wanted == "auto":
        unit = min(UNITS_NS, key=lambda u: abs(np.log(max(span, 1e-12) * UNITS_NS[u] / period_ns)))
    seconds = span * UNITS_NS[unit] / 1e9
    fits = 0.05 < span * UNITS_NS[unit] / period_ns < LONGEST
    misfit = f"`{name}` in {unit} makes a scan last {seconds:.3g} s, yet they come every {period_ns / 1e9:.3f} s"
    problem = ""
    if first.dtype == np.float32 and first.any() and float(np.spacing(np.abs(first).max())) > 0.02 * span:
        problem = f"`{name}` is float32, too coarse for values like {float(first.max()):.0f}"
    elif span <= 0.0:
        problem = f"`{name}` is the same for all points of a scan"
    elif not fits and wanted == "auto":
        problem = misfit
    facts = f"`{name}` ({first.dtype}) in {unit}: a scan then lasts {seconds:.4f} s and they come every"
    facts += f" {period_ns / 1e9:.4f} s"
    if problem:
        finding = Finding("point time", "needs you", problem, "--set recording.time_field=none")
    elif not fits:
        finding = Finding("point time", "needs you", misfit, "--set recording.time_unit=auto")
    else:
        facts += ", as you set it" if chosen.time_unit != "auto" else ""
        finding = Finding("point time", "fine", facts)
    return UNITS_NS[unit], problem, finding


def _settle_reference(
    name: str, unit_ns: int, clouds: list[Probe], chosen: RecordingParams, period_ns: int
) -> tuple[Timing, list[Finding]]:
    """The moment from which the field counts, and the point to which the header stamp belongs."""
    times = [exact_ns(probe.column(name), unit_ns) for probe in clouds]
    least = [base + int(after.min()) for base, after in times]
    most = [base + int(after.max()) for base, after in times]
    stamps = [probe.cloud.stamp_ns for probe in clouds]
    to_first = float(np.median([s - t for s, t in zip(stamps, least, strict=True)]))
    to_last = float(np.median([s - t for s, t in zip(stamps, most, strict=True)]))
    near = min(abs(to_first), abs(to_last)) < max(2e9, 3 * period_ns)
    # The clock of a simulator starts at zero, so its times are small at first, but they advance with the headers.
    elapsed = stamps[-1] - stamps[0]
    runs_on = elapsed > 0 and abs(least[-1] - least[0] - elapsed) < 0.5 * elapsed
    small = max(abs(min(least)), abs(max(most))) < 3 * period_ns and not runs_on
    if chosen.time_reference == "absolute" or (chosen.time_reference == "auto" and near and not small):
        timing = Timing(name, unit_ns, "absolute", 0, period_ns)
        return timing, _absolute_findings(to_first, to_last, period_ns, chosen, near)
    header, stamp_finding = _settle_header(clouds, least, most, period_ns, chosen)
    if small:
        shift, before, after = 0, min(least) < -0.1 * period_ns, max(most) > 0.1 * period_ns
        if before and after and chosen.header_stamp == "auto":
            text = "of a point within the scan: the points' times count from it, both ways"
            stamp_finding = Finding("header stamp", "fine", text)
        elif header == "first" and before:
            shift = -min(least)
        elif header == "last" and after:
            shift = -max(most)
        timing = Timing(name, unit_ns, "header", shift, period_ns)
        text = f"`{name}` counts from the header stamp (it stays below the duration of a scan)"
        return timing, [Finding("time reference", "fine", text), stamp_finding]
    away = min((to_first, to_last), key=abs) / 1e9
    text = (
        f"`{name}` runs on a clock of its own, {abs(away):.3f} s {'behind' if away > 0 else 'ahead of'} the header"
        f" stamp; each scan's {header} point was put at its header stamp"
    )
    finding = Finding("time reference", "corrected", text, "--set recording.time_reference=absolute")
    return Timing(name, unit_ns, header, 0, period_ns), [finding, stamp_finding]


def _absolute_findings(
    to_first: float, to_last: float, period_ns: int, chosen: RecordingParams, near: bool
) -> list[Finding]:
    header, offset = ("first", to_first) if abs(to_first) < abs(to_last) else ("last", to_last)
    if not near:
        text = f"taken as absolute, as you set it, yet {abs(offset) / 1e9:.1f} s from the header stamps"
        return [Finding("time reference", "needs you", text, "--set recording.time_reference=auto")]
    agrees = Finding("time reference", "fine", "absolute: it agrees with the header stamps")
    if abs(offset) < 0.3 * period_ns:
        text = f"of the {header} point, to {abs(offset) / 1e6:.1f} ms; the points' own times are used"
        if chosen.header_stamp not in ("auto", header):
            text += f", so `{chosen.header_stamp}` as you set it has no effect"
        return [agrees, Finding("header stamp", "fine", text)]
    text = f"{offset / 1e9:+.3f} s from the {header} point; the points' own times are used"
    return [agrees, Finding("header stamp", "corrected", text, "--set recording.time_reference=relative")]


def _settle_header(
    clouds: list[Probe], least: list[int], most: list[int], period_ns: int, chosen: RecordingParams
) -> tuple[End, Finding]:
    """The point to which the header stamp belongs."""
    if chosen.header_stamp != "auto":
        return _header(chosen.header_stamp, "as you set it", "fine")
    duration = float(np.median([m - i for i, m in zip(least, most, strict=True)]))
    if max(abs(min(least)), abs(max(most))) >= 3 * period_ns:
        return _header_by_delay(clouds, duration)
    if max(most) < 0.1 * period_ns:
        return _header("last", "the points' times are negative, before it", "fine")
    delay = log_delay_ns(clouds)
    if delay is not None and delay < 0.5 * duration:
        text = (
            f"the clouds were logged {delay / 1e6:.0f} ms after it, "
            f"when a scan of {duration / 1e6:.0f} ms that began there could not be over"
        )
        return _header("last", text, "corrected")
    return _header("first", "the points' times count up from it", "fine")


def _header_by_delay(clouds: list[Probe], duration_ns: float) -> tuple[End, Finding]:
    """The header's point, judged by how long after it the clouds were logged; without evidence, the last."""
    delay = log_delay_ns(clouds)
    if delay is None:
        return _header("last", "the recording does not show which; most drivers take the last; if not:", "needs you")
    text = f"the clouds were logged {delay / 1e6:.0f} ms after it, and a scan takes {duration_ns / 1e6:.0f} ms"
    if delay < 0.5 * duration_ns:
        return _header("last", text, "corrected")
    if 0.9 * duration_ns < delay < 3 * duration_ns:
        return _header("first", text, "corrected")
    return _header("last", f"{text}, which does not decide it; most drivers take the last; if not:", "needs you")


def _header(end: End, evidence: str, verdict: FindingVerdict) -> tuple[End, Finding]:
    option = f"--set recording.header_stamp={'first' if end == 'last' else 'last'}"
    return end, Finding("header stamp", verdict, f"of the {end} point: {evidence}", option)


def log_delay_ns(clouds: list[Probe]) -> float | None:
    """Median of log time minus header stamp; None if this is not evidence (copied stamps, or unrelated clocks)."""
    if not clouds[0].stamped:
        return 0.0
    delays = np.array([probe.log_ns - probe.cloud.stamp_ns for probe in clouds], np.float64)
    delay = float(np.median(delays))
    if np.all(np.abs(delays) < 2_000) or not -1e6 < delay < 5e9:
        return None  # the writer copied the stamp, or the clocks have nothing to do with each other
    return delay


def _without_field(
    clouds: list[Probe], chosen: RecordingParams, period_ns: int, period_known: bool, rejected: list[str]
) -> tuple[Timing, list[Finding]]:
    measured = period_ns
    if chosen.rotation_rate > 0:
        period_ns = round(1e9 / chosen.rotation_rate)
        rate = f"{chosen.rotation_rate:g} revolutions per second, as you set it"
    elif period_known:
        rate = f"{1e9 / period_ns:.3g} revolutions per second, the rate of the clouds"
    else:
        rate = "10 revolutions per second, assumed"
    why = "; ".join(rejected) or ("as you set it" if chosen.time_field == "none" else "the clouds have no time field")
    agrees = not period_known or 0.9 < period_ns / measured < 1.1
    text = f"derived from the azimuth at {rate} ({why}); times recorded by the driver would be better"
    if not agrees:
        text += f"; but clouds come every {measured / 1e9:.3f} s"
    verdict: FindingVerdict = "corrected" if agrees and period_known else "needs you"
    finding = Finding("point time", verdict, text, "--set recording.rotation_rate=10")
    if chosen.header_stamp == "auto":
        header, stamp_finding = _header_by_delay(clouds, period_ns)
    else:
        header, stamp_finding = _header(chosen.header_stamp, "as you set it", "fine")
    shift = -period_ns if header == "last" else 0
    return Timing(None, 1, "header", shift, period_ns), [finding, stamp_finding]


def exact_ns(time: npt.NDArray[Any], unit_ns: int) -> tuple[int, I64]:
    """Times of any type as (base, (n,) int64 after it), ns, without losing digits of large values."""
    if time.dtype.kind == "f":
        values = time.astype(np.float64)
        whole = float(np.floor(values.min()))
        values -= whole
        values *= unit_ns
        return int(whole) * unit_ns, np.rint(np.minimum(values, MOST_NS, out=values), out=values).astype(np.int64)
    least = time.min()
    after = np.minimum((time - least).astype(np.uint64), MOST_NS // unit_ns)
    return int(least) * unit_ns, after.astype(np.int64) * unit_ns
