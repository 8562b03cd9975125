"""Distance of the map to another map, in colours and as a histogram. The other map is a file or made by the truth."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import viser

from app.evaluation.cloud_distance import REACH_M, Comparison
from app.evaluation.map_comparison import KeyframePoints, MapsToCompare, find, sentences
from app.export.read_points import CLOUDS
from app.server.folders import Folders
from app.server.protocol import Snapshot
from app.ui.background import Background
from app.ui.colours import DENSITY, DISTANCE, LOOK, MODES, TABLES, Limits, value_colours
from app.ui.files import FileList
from app.ui.html import Tile, number, panel
from app.ui.map_numbers import Density, MapNumbers
from app.ui.widgets import Changes, Page, View, add_button, dialog, limited

_BINS: Final = 41
_LEAST_M: Final = 0.005
"""The colours cover at least this distance on either side."""
_WHAT: Final = "How far each point of the map lies in front of the surface of another map, or behind it."
_OLD: Final = "The map has changed since: distances are from before, and new points are grey. Compare again."


class MapComparePanel:
    """Widgets in the caller's container; the distances colour the map.

    Args:
        results: folder below which results are saved. colour_by: chooses a colour mode.
    """

    def __init__(self, page: Page, folders: Folders, results: Path, colour_by: Callable[[str], None]) -> None:
        gui = page.gui
        self._page, self._folders, self._results, self._colour_by = page, folders, results, colour_by
        self._session, self._before = -1, LOOK  # the colour mode that distances replaced
        self._asked = Snapshot(), ""  # map and name of the other map in the comparison that was begun
        self._compared, self._name = self._asked  # in the comparison that is shown
        self._comparison: Comparison | None = None
        self._distance: MapNumbers | None = None
        self._density = Density(page.now)
        self._changes = Changes()
        gui.add_html(panel("quiet", _WHAT))
        self._found = gui.add_html("")
        self._choose = add_button(gui, "Choose a map…", self._browse, viser.Icon.FOLDER_OPEN, hint="PLY, LAS, LAZ.")
        hint = "The same scans, placed at the true poses."
        self._truth = add_button(
            gui, "The map by the truth", self._by_truth, viser.Icon.ROUTE, visible=False, hint=hint
        )
        self._fit = gui.add_checkbox(
            "fit it first", False, hint="Move the other map onto this one; they must lie within 2 m and a few degrees."
        )
        self._reach = limited(
            gui.add_number(
                "reach (m)",
                REACH_M,
                min=0.05,
                max=5.0,
                step=0.05,
                hint="Points farther apart than this have no counterpart.",
            )
        )
        self._work = Background(gui, "compare", "The comparison")

    def seen(self, current: Snapshot, view: View) -> View:
        """The view with the numbers that its colour mode needs."""
        if view.colour_by != DISTANCE:
            self._before = view.colour_by
        if view.colour_by == DENSITY:
            return replace(view, numbers=self._density.of(current.chunks, current.keyframe_poses))
        return replace(view, numbers=self._distance) if view.colour_by == DISTANCE else view

    def draw(self, current: Snapshot) -> None:
        if current.session != self._session:
            self._session = current.session
            self._clear()
        self._receive()
        running, recording = self._work.running, current.recording
        self._choose.disabled = self._truth.disabled = running or not current.chunks
        self._truth.visible = recording is not None and recording.truth is not None
        then = self._compared
        moved = current.chunks is not then.chunks or current.keyframe_poses is not then.keyframe_poses
        old = self._distance is not None and moved
        if self._changes(self._comparison, old):
            found = self._comparison
            self._found.content = summary(found, self._name, [_OLD] if old else []) if found is not None else ""

    def close(self) -> None:
        """Stop the comparison that is running, if any."""
        self._work.stop()

    def _clear(self) -> None:
        """Discard the comparison of the previous session."""
        self.close()
        if self._comparison is not None:
            self._comparison = self._distance = None
            self._colour_by(self._before)

    def _browse(self, client: viser.ClientHandle) -> None:
        folders = self._folders.and_also(self._results)
        with dialog(client, "Compare with a map") as close:
            nothing = "No maps (.ply, .las, .laz) here. “Save results…” writes one."
            FileList(client.gui, folders, CLOUDS, nothing, lambda path: self._begin(folders.inside(path)), close)

    def _by_truth(self, _: viser.ClientHandle) -> None:
        recording = self._page.snapshot().recording
        if recording is not None and recording.truth is not None:
            self._begin(recording.truth, by_truth=True)

    def _begin(self, other: Path, *, by_truth: bool = False) -> None:
        current = self._page.snapshot()
        if self._work.running or not current.chunks:
            return
        poses, found = current.keyframe_poses, current.earth.found
        scans = tuple(
            KeyframePoints(chunk.points, chunk.stamp_ns, poses[chunk.index], chunk.T_imu_lidar)
            for chunk in current.chunks
        )
        where = found.reference if found is not None else None
        wanted = MapsToCompare(
            scans, other, by_truth, where, self._fit.value and not by_truth, float(self._reach.value)
        )
        self._asked = current, "the truth" if by_truth else other.name
        self._work.begin(find, wanted)

    def _receive(self) -> None:
        for message in self._work.messages():
            match message:
                case Comparison():
                    self.close()
                    self._comparison, (self._compared, self._name) = message, self._asked
                    self._distance = MapNumbers.split(self._compared.chunks, message.distance, _limits(message))
                    self._colour_by(DISTANCE)
                case sentence:
                    self.close()
                    self._page.notify_error(sentence)


def _limits(found: Comparison) -> Limits:
    """Symmetric about zero, so that grey means no distance."""
    end = round(max(float(np.nan_to_num(found.p95)), _LEAST_M), 3)
    return Limits(-end, end)


def summary(found: Comparison, name: str, notes: list[str]) -> str:
    """A comparison in numbers, and a histogram of its distances in the colours of the map."""
    limits = _limits(found)
    counts, edges = np.histogram(np.clip(found.known, limits.low, limits.high), _BINS, (limits.low, limits.high))
    colours = value_colours((edges[:-1] + edges[1:]) / 2, limits, TABLES[MODES[DISTANCE].table])
    bars = [
        (tuple(rgb), share)
        for rgb, share in zip(colours.tolist(), (counts / max(counts.max(), 1)).tolist(), strict=True)
    ]
    tiles = [
        Tile("median", f"{round(100 * found.median, 1) + 0.0:+.1f}", "cm"),
        Tile("half within", number(100 * found.typical, 1), "cm"),
        Tile("95 % within", number(100 * found.p95, 1), "cm"),
    ]
    words = [*sentences(found, name), *notes]
    alt = f"Distances to {name}, from {100 * limits.low:.1f} to {100 * limits.high:.1f} cm"
    low, high = (f"{100 * end:+.1f} cm" for end in (limits.low, limits.high))
    return panel("compared", tiles, words) + panel("histogram", bars, low, high, alt)
