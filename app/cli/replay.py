"""`hemislam replay`: repeats a session of the workbench, without a browser."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.cli.options import Force, RunFolder
from app.slam.errors import HemislamError

if TYPE_CHECKING:
    from app.mapping.session import Session


def replay(
    session: Annotated[
        Path, typer.Argument(metavar="SESSION", help="A session file that the workbench has written (.hemislam).")
    ],
    out: RunFolder = None,
    force: Force = False,
    to_end: Annotated[
        bool, typer.Option("--to-end", help="Continue to the end of the recording with the last parameters.")
    ] = False,
) -> None:
    """Repeat a session of the workbench to the same result.

    The workbench writes a session file to runs/sessions/ while you work, and saves one beside the results.
    It contains the recording's path, the parameters with the frame from which they applied, and the loop
    edits. Writes the same files as `hemislam run`.

    \b
    Examples:
      hemislam replay runs/sessions/walk-20261121-101500.hemislam
      hemislam replay session.hemislam --to-end --out results/walk
    """
    from app.cli.run import free_folder, save
    from app.export.exports import results_folder

    folder = out or free_folder(session)
    with results_folder(folder, replace=force), repeat(session, to_end=to_end) as (work, stop):
        save(work, folder, stop, replace=force)


@contextmanager
def repeat(path: Path, *, to_end: bool = False) -> "Iterator[tuple[Session, BaseException | None]]":
    """The session of a file, repeated, and what stopped it early.

    Raises:
        HemislamError: it cannot be read or repeated, or ended before its first frame.
    """
    from app.cli.run import compile_behind_bar, process
    from app.mapping.opening import open_session
    from app.mapping.session_file import read_session

    saved = read_session(path)
    if saved.left_out:
        typer.echo(f"hemislam: {saved.left_out}", err=True)
    opened, truth = saved.opened, saved.state.truth
    if truth is not None and not truth.exists():  # only the errors against it are lost
        typer.echo(f"The session was compared with {truth}, which no longer exists.")
        truth = None
    part = opened.start_s, opened.duration_s
    session = open_session(opened.recording, saved.first_params, *part, truth=truth, read_ahead=True)
    try:
        compile_behind_bar()
        session.resume(saved)
        session.go_to(saved.frame)
        stop = process(session, until=None if to_end or saved.ended else saved.frame)
        if session.frame < 0:
            raise stop or HemislamError(f"The session {path} ended before its first frame; there is nothing to repeat.")
        yield session, stop
    finally:
        session.close()
