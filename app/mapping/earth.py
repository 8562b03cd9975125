"""Georeferences results as the user of a session asked: by satellite fixes, or by control points."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from app.export.results import Results
from app.georeference.align import Alignment, align
from app.georeference.bend import bend
from app.georeference.control import align_with_points, control_table
from app.georeference.fixes import Fixes
from app.georeference.reference import ELLIPSOIDAL
from app.georeference.survey import Survey
from app.georeference.tables import read_fixes
from app.mapping.kept import is_there
from app.sensors.navsat import recorded_fixes
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.loops.edits import LoopEdit, Override
from app.slam.loops.solvers import read_g2o
from app.slam.map_frame import MapFrame

FIX, POINT = "fix ", "point "
"""The name of the subject of an `Override` begins with one of these."""


def georeference(results: Results, survey: Survey, edits: Sequence[LoopEdit] = ()) -> Results:
    """The results with their place on Earth, and with the residuals of the fixes or control points.

    Raises:
        HemislamError: the survey cannot be read, or does not determine where the map lies.
    """
    if not len(results.trajectory):
        raise HemislamError("Nothing is mapped yet that could be georeferenced.")
    overridden = {edit.what: edit.accepted for edit in edits if isinstance(edit, Override)}
    if survey.control:
        found = _by_points(results, survey, _named(overridden, POINT))
        return replace(results, where=found.reference, found=found)
    fixes, heights = fixes_of(results.info.recording, survey.gnss, int(results.trajectory.stamps_ns[0]))
    of_fixes = _named(overridden, FIX)
    found = align(
        results.trajectory,
        fixes,
        grid=survey.crs,
        height=survey.height or heights,
        lever=survey.lever,
        offset_s=survey.offset_s,
        overridden=of_fixes,
    )
    if survey.factors:
        return bent(results, fixes, found, of_fixes)
    return replace(results, where=found.reference, found=found)


def georeference_if_possible(results: Results, survey: Survey | None, edits: Sequence[LoopEdit] = ()) -> Results:
    """As `georeference`; if that fails, the results as they are, with the reason."""
    try:
        return results if survey is None else georeference(results, survey, edits)
    except HemislamError as error:
        return replace(results, problem=str(error))


def bent(results: Results, fixes: Fixes, found: Alignment, overridden: Mapping[str, bool]) -> Results:
    """As `georeference`, by fixes that bend the map. found: their alignment with the map as it is."""
    loops = results.loops
    if loops is None or not loops.g2o:
        raise HemislamError(
            f"{results.info.recording} has no graph.g2o that fixes could bend; run the recording with loops.enabled."
        )
    try:
        graph = read_g2o(loops.g2o)
    except RuntimeError:
        raise HemislamError(f"The graph of {results.info.recording} cannot be read.") from None
    every = range(len(results.keyframes))
    stamps_ns = loops.stamps_ns if len(loops.stamps_ns) else np.array([results.keyframes[k].stamp_ns for k in every])
    corrections, found = bend(results.trajectory, stamps_ns, graph, fixes, found, overridden)
    adjustment = MapFrame(stamps_ns, corrections).over(results.adjustment)
    return replace(results, adjustment=adjustment, where=found.reference, found=found)


def fixes_of(recording: Path, gnss: Path | None, near_ns: int) -> tuple[Fixes, str]:
    """The fixes of a file, or of the recording, and what their heights are above. near_ns: as in `read_fixes`."""
    path = gnss or recording
    return _read(recording, gnss, near_ns, path.stat().st_mtime_ns if path.exists() else 0)


@lru_cache(maxsize=2)
def _read(recording: Path, gnss: Path | None, near_ns: int, changed_ns: int) -> tuple[Fixes, str]:
    """As `fixes_of`, cached: an hour's recording takes seconds to read, at every click. changed_ns: of the file."""
    return read_fixes(gnss, near_ns) if gnss is not None else (recorded_fixes(recording), ELLIPSOIDAL)


def _by_points(results: Results, survey: Survey, overridden: Mapping[str, bool]) -> Alignment:
    """The alignment by the control points that were picked on keyframes so far."""
    table = control_table(survey.control)
    picked = {}
    for pick in survey.picks:
        if is_there(pick, results.keyframes):
            T = results.frame.at(pick.keyframe) @ results.keyframes[pick.keyframe].T_odom_imu
            picked[pick.name] = lie.moved(T, pick.at)
    return align_with_points(table, picked, grid=survey.crs, height=survey.height or ELLIPSOIDAL, overridden=overridden)


def _named(overridden: Mapping[str, bool], kind: str) -> dict[str, bool]:
    return {what.removeprefix(kind): accepted for what, accepted in overridden.items() if what.startswith(kind)}
