"""Writes the results of a session beside its frames, one save after the other."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from app.mapping.labels import LabelledKeyframes
from app.mapping.session_file import SUFFIX, SavedSession, write_session
from app.slam.errors import HemislamError
from app.slam.loops.files import LoopResults
from app.slam.map_frame import MapFrame
from app.slam.results import RunInfo, RunLog, prepare_folder, save_results
from app.slam.trajectory import write_tum


class Saver:
    """A thread that saves, and what it has to do. It reads keyframes that must not be replaced before `finish`."""

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="save")
        self._saves: list[Future[dict[str, Any]]] = []

    def save(
        self,
        folder: Path,
        log: RunLog,
        keyframes: LabelledKeyframes,
        info: RunInfo,
        loops: LoopResults | None,
        session: SavedSession | None,
        *,
        replace: bool,
    ) -> "Future[dict[str, Any]]":
        """Write all results of these frames and keyframes, and the session."""

        def write() -> dict[str, Any]:
            report = save_results(folder, log, keyframes, info, loops, replace=replace)
            if session is not None:
                _save_session(folder / f"session{SUFFIX}", session)
            return report

        return self._start(write)

    def save_trajectory(self, folder: Path, log: RunLog, loops: LoopResults | None) -> "Future[dict[str, Any]]":
        """Write trajectory.tum alone."""

        def write() -> dict[str, Any]:
            prepare_folder(folder, replace=True)
            write_tum(folder / "trajectory.tum", (loops.frame if loops else MapFrame()).trajectory(log.odometry))
            return {}

        return self._start(write)

    def _start(self, write: Callable[[], dict[str, Any]]) -> "Future[dict[str, Any]]":
        self._saves = [save for save in self._saves if not save.done()]
        self._saves.append(self._thread.submit(write))
        return self._saves[-1]

    def finish(self) -> None:
        """Wait until no save is under way."""
        for save in self._saves:
            save.exception()

    def close(self) -> None:
        self._thread.shutdown(wait=True)


def _save_session(path: Path, session: SavedSession) -> None:
    try:
        write_session(path, session)
    except OSError as error:
        raise HemislamError(f"The session cannot be written to {path}: {error.strerror}.") from error
