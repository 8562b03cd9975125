"""The settings for starting an engine's process."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from app.mapping.breakpoints import Breakpoints
from app.mapping.kept import NOTHING_KEPT, Kept
from app.sensors.live.address import LiveAddress
from app.slam.params import Params

POINT_BUDGET = 3_000_000
"""Most map points that a page draws."""
HELD = 3
"""The server holds this multiple of that number, 220 MB, so that each page can show details of the part in view."""


@dataclass(frozen=True, slots=True)
class Seen:
    """Counts that the reader already has from an earlier process; the numbers of sessions and notices continue them."""

    session: int = 0
    notices: int = 0
    frames: int = 0
    chunks: int = 0


NOTHING_SEEN = Seen()


@dataclass(frozen=True, slots=True)
class Setup:
    """The settings for starting an engine's process. Must be picklable.

    Attributes:
        recording: the one to open; None: wait for OpenRecording. start_s, duration_s: the part to process.
        resolve, session_folder: see `Controller`. play: start playback at once.
        point_budget: most points of the map that a page draws. checkpoint_bytes: memory for checkpoints.
        live: source of scans if `recording` is `app.server.protocol.LIVE`. live_folder: for files from which another
            process can take over. revive: whether this process takes over. seen: counts that the reader already has.
        kept: user data of a live session that another process began.
    """

    recording: Path | None = None
    truth: Path | None = None
    params: Params = field(default_factory=Params)
    start_s: float = 0.0
    duration_s: float | None = None
    resolve: Callable[[Path], Params] | None = None
    play: bool = False
    speed: float = 1.0
    breakpoints: Breakpoints = field(default_factory=Breakpoints)
    point_budget: int = POINT_BUDGET
    checkpoint_bytes: int = 1 << 30
    live: LiveAddress | None = None
    live_folder: Path | None = None
    revive: bool = False
    session_folder: Path | None = None
    seen: Seen = NOTHING_SEEN
    kept: Kept = NOTHING_KEPT
