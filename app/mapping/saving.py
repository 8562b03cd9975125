"""Writes the results of a session: the files of a run, or files in other formats."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from app.export.exports import BY_RUN, of_formats, save_results
from app.export.results import Results
from app.georeference.survey import Survey
from app.mapping.kept import Kept, is_there
from app.mapping.session_file import SUFFIX, SavedSession, write_session
from app.slam.loops.edits import LoopEdit


def write_all(
    folder: Path,
    results: Results,
    survey: Survey | None,
    edits: Sequence[LoopEdit],
    session: SavedSession | None,
    formats: Sequence[str],
    *,
    replace: bool,
) -> dict[str, Any]:
    """Write the results, georeferenced if that is possible. Arguments as in `Session.save`."""
    if session is not None:
        mark(results, session.state)
    if survey is not None:
        from app.mapping.earth import georeference_if_possible  # few sessions need its solvers

        results = georeference_if_possible(results, survey, edits)
    report = save_results(folder, results, of_formats(formats) if formats else BY_RUN, replace=replace)
    if session is not None and not formats:
        write_session(folder / f"session{SUFFIX}", session)
    return report


def mark(results: Results, kept: Kept) -> None:
    """Add the measures and notes, which some files show."""
    results.marks = tuple(
        (one.name, tuple((spot.keyframe, spot.at) for spot in one.spots))
        for one in kept.measures
        if all(is_there(spot, results.keyframes) for spot in one.spots)
    )
    results.notes = tuple((note.frame, note.text) for note in kept.notes)
