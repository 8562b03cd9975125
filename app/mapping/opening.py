"""Opens a recording as a session."""

from collections.abc import Callable
from pathlib import Path

from app.mapping.checkpoints import Checkpoints
from app.mapping.feed import FileFeed
from app.mapping.loops import RestartingLoops
from app.mapping.session import Session
from app.slam.engine import Engine
from app.slam.loops.keyframe_log import KeyframeLog
from app.slam.loops.messages import LoopClient
from app.slam.params import Params


def open_session(
    path: Path,
    params: Params,
    start_s: float = 0.0,
    duration_s: float | None = None,
    *,
    truth: Path | None = None,
    loops: Callable[[KeyframeLog], LoopClient] = RestartingLoops,
    checkpoint_bytes: int | None = None,
    read_ahead: bool = False,
) -> Session:
    """Open a recording, or a part of it, with a new engine.

    Args:
        truth: a trajectory (TUM) to compare with.
        loops: makes the client that looks for loops, if `loops.enabled`.
        checkpoint_bytes: memory for checkpoints; None: the session only goes forward.
        read_ahead: as in `FileFeed`.

    Raises:
        HemislamError: the recording or the truth cannot be used.
    """
    feed = FileFeed(path, params, start_s, duration_s, read_ahead=read_ahead)
    try:
        return Session(
            feed,
            Engine(params),
            loops=loops if params.loops.enabled else None,
            truth=truth,
            checkpoints=None if checkpoint_bytes is None else Checkpoints(checkpoint_bytes),
        )
    except BaseException:
        feed.close()
        raise
