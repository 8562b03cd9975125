"""`hemislam replay`: a session of the workbench once more, without a browser."""

from pathlib import Path
from typing import Annotated

import typer

from app.slam.errors import HemislamError


def replay(
    session: Annotated[
        Path, typer.Argument(metavar="SESSION", help="A session file that the workbench has written (.hemislam).")
    ],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Where to write; else runs/NAME-1, -2, ...")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace results that DIR already holds.")] = False,
    to_end: Annotated[
        bool, typer.Option("--to-end", help="Go on to the end of the recording with the last parameters.")
    ] = False,
) -> None:
    """Repeat a session of the workbench to the same result.

    A session is kept in runs/sessions/ while it goes on, and saved beside its results. It holds what
    was opened, the parameters by the frame from which on they were in force, and the edits of
    loops. Writes the same files as `hemislam run`.

    \b
    Examples:
      hemislam replay runs/sessions/walk-20261121-101500.hemislam
      hemislam replay session.hemislam --to-end --out results/walk
    """
    from app.cli.run import compile_behind_bar, free_folder, process, save
    from app.server.journal import read_session
    from app.server.run import open_run
    from app.slam.results import RunInfo, prepare_folder
    from app.slam.trajectory import read_tum

    saved = read_session(session)
    opened, state = saved.opened, saved.state
    first = state.history[0][1] if state.history else state.params
    truth_path = opened.truth
    if truth_path is not None and not truth_path.exists():  # nothing of the walk follows from it
        typer.echo(f"The session was compared with {truth_path}, which is gone.")
        truth_path = None
    work = open_run(opened.recording, truth_path, first, opened.start_s, opened.duration_s)
    folder = out or free_folder(session)
    try:
        prepare_folder(folder, replace=force)
        compile_behind_bar()
        if work.engine.loops:
            work.engine.loops.wait_ready()
        work.resume(saved)
        stop = process(work, until=None if to_end else saved.frame)
        if not len(work.log):
            raise stop or HemislamError(
                f"The session {session} ended before its first frame; there is nothing to repeat."
            )
        info = RunInfo(
            recording=opened.recording,
            params=work.engine.params,
            start_s=opened.start_s,
            duration_s=opened.duration_s,
            truth=read_tum(truth_path) if truth_path else None,
            truth_path=truth_path,
            stopped="" if stop is None else str(stop) or type(stop).__name__,
        )
        save(work, folder, info, stop, replace=force)
    finally:
        work.close()
