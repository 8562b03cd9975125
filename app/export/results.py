"""The data from which result files are written: frames, keyframes and loops of a session, and facts about them."""

from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

from app.export.points import EVERYTHING, Block, Choice, blocks
from app.export.raster import CELL, COARSE_CELL, Raster, rasterise
from app.export.section import Slab, of_box, of_path
from app.georeference.reference import GeoReference
from app.slam.errors import HemislamError
from app.slam.loops.files import LoopResults
from app.slam.map_frame import MapFrame
from app.slam.ply import Keyframes
from app.slam.run_log import RunInfo, RunLog
from app.slam.trajectory import Trajectory

if TYPE_CHECKING:  # every run imports this module, but few need the solver
    from app.georeference.align import Alignment

MapMark = tuple[str, tuple[tuple[int, tuple[float, float, float]], ...]]


@dataclass
class Results:
    """The data from which the result files are written.

    Attributes:
        loops: None if loops were not searched. adjustment: of the map after loops: levels it by `levelled_deg`, and
            bends it to fixes.
        report: content of report.json; complete once that is written.
        choice: of points. where: georeference of the map, if known. found: fit of fixes or control points, if these
            results were georeferenced. problem: why they could not be georeferenced, in a sentence.
        marks: measures, each a name and its spots: keyframe and (x, y, z) m in the keyframe's IMU frame.
        notes: of the session, each a frame's index and a text.
        progress: called with the share of the points written, 0-1, for each file.
        sha256: of the recording, computed when report.json is written; None if the recording cannot be read.
    """

    log: RunLog
    keyframes: Keyframes
    info: RunInfo
    loops: LoopResults | None = None
    adjustment: MapFrame = field(default_factory=MapFrame)
    levelled_deg: float = 0.0
    report: dict[str, Any] = field(default_factory=dict)
    choice: Choice = EVERYTHING
    where: GeoReference | None = None
    found: "Alignment | None" = None
    problem: str = ""
    marks: tuple[MapMark, ...] = ()
    notes: tuple[tuple[int, str], ...] = ()
    progress: Callable[[float], None] = lambda share: None
    sha256: Future[str | None] = field(default_factory=Future, init=False, repr=False)

    @property
    def frame(self) -> MapFrame:
        """The transform from odometry to the map."""
        return self.adjustment.over(self.loops.frame if self.loops else MapFrame())

    @cached_property
    def trajectory(self) -> Trajectory:
        """T_map_imu at every scan's end."""
        return self.frame.trajectory(self.log.odometry)

    def blocks(self) -> Iterator[Block]:
        """The chosen points in the map, keyframe by keyframe; only one keyframe is in memory at a time."""
        return self._blocks(self.choice)

    def still_blocks(self) -> Iterator[Block]:
        """As `blocks`, without points on moving objects, for formats that cannot mark them."""
        return self._blocks(replace(self.choice, moving=False))

    def _blocks(self, choice: Choice) -> Iterator[Block]:
        count = 0
        for number, block in enumerate(blocks(self.keyframes, self.frame, choice), 1):
            count += len(block)
            yield block
            self.progress(number / len(self.keyframes))
        if choice.box is not None and not count:
            raise HemislamError("There are no points in the box; choose another one.")

    # each of these is computed once for all files that show it
    @cached_property
    def raster_in_map(self) -> Raster:
        """The map from above, along the map's axes."""
        return rasterise(self.still_blocks, None, CELL)

    @cached_property
    def raster(self) -> Raster:
        """The map from above, along the axes of the grid on Earth, if that is known."""
        return self.raster_in_map if self.where is None else rasterise(self.still_blocks, self.where, CELL)

    @cached_property
    def coarse_raster(self) -> Raster:
        """As `raster`, with larger cells."""
        return rasterise(self.still_blocks, self.where, COARSE_CELL)

    @cached_property
    def section(self) -> Slab:
        """The content of the box from its front."""
        return of_box(self.still_blocks, self.choice.box, self.where)

    @cached_property
    def profile(self) -> Slab:
        """The points along the walked path, from its side."""
        return of_path(self.still_blocks, self.trajectory.positions, self.choice.slab / 2, self.where)
