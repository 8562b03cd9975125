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

    The workbench keeps a session file in runs/sessions/ while a session goes on, and saves one beside
    the results. It holds what was opened, the parameters by the frame from which they were in force,
    and the edits of loops. Writes the same files as `hemislam run`.

    \b
    Examples:
      hemislam replay runs/sessions/walk-20261121-101500.hemislam
      hemislam replay session.hemislam --to-end --out results/walk
    """
    from app.cli.run import free_folder, prepare, process, save
    from app.mapping.opening import open_session
    from app.mapping.session_file import read_session
    from app.slam.results import prepare_folder

    saved = read_session(session)
    opened, truth = saved.opened, saved.state.truth
    if truth is not None and not truth.exists():  # no result but its errors follows from it
        typer.echo(f"The session was compared with {truth}, which is gone.")
        truth = None
    work = open_session(opened.recording, saved.first_params, opened.start_s, opened.duration_s, truth=truth)
    folder = out or free_folder(session)
    try:
        prepare_folder(folder, replace=force)
        prepare(work)
        work.resume(saved)
        work.go_to(saved.frame)
        stop = process(work, until=None if to_end or saved.ended else saved.frame)
        if work.frame < 0:
            raise stop or HemislamError(
                f"The session {session} ended before its first frame; there is nothing to repeat."
            )
        save(work, folder, stop, replace=force)
    finally:
        work.close()
