"""What an engine's process is started with."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from app.mapping.breakpoints import Breakpoints
from app.slam.params import Params

if TYPE_CHECKING:
    from app.sensors.live.address import LiveAddress


POINT_BUDGET = 3_000_000


@dataclass(frozen=True, slots=True)
class Setup:
    """What an engine's process starts with. Must be picklable.

    Attributes:
        recording: to open, or None to wait for OpenRecording. truth: its truth, if not beside it.
        start_s, duration_s: the part of that recording to process.
        resolve: parameters for recordings opened later; None keeps the present ones.
        play: begin at once. speed: to play at. breakpoints: where to pause.
        point_budget: most points of the map that are held for pages, see `app.server.chunks`.
        checkpoint_bytes: see `app.mapping.checkpoints`.
        live_folder: where a live run keeps what a process that takes over needs. revive: it is that process.
        live: where to take scans from while `recording` is `app.server.protocol.LIVE`.
        session_folder: folder for session files, see `Controller`.
        session, notices, frames, chunks: how many there were before, for a process that takes over from another.
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
    live: "LiveAddress | None" = None
    live_folder: Path | None = None
    revive: bool = False
    session_folder: Path | None = None
    session: int = 0
    notices: int = 0
    frames: int = 0
    chunks: int = 0
