"""Opening a recording and saving results. The page sees only the folders that the command line allowed."""

from collections.abc import Callable
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, Final

import viser

from app.mapping.session_file import SUFFIX
from app.server.folders import RECORDINGS, TRAJECTORIES, Entry, Folders
from app.server.protocol import CompareWith, OpenRecording, Save, Snapshot
from app.slam.errors import HemislamError
from app.slam.results import EXPORTS
from app.slam.trajectory import truth_beside
from app.ui.html import panel
from app.ui.widgets import Page, by_user, dialog

_MOST_ENTRIES: Final = 60


def size_text(size: int) -> str:
    """Bytes in the unit a person would choose."""
    value = float(size)
    for unit in ("B", "kB", "MB"):
        if value < 1000:
            return f"{value:.0f} {unit}"
        value /= 1000
    return f"{value:.1f} GB"


def result_folder_name(recording: Path, now: datetime) -> str:
    """`hall_bpearl-2026-05-01-134502`: sorts by recording, then by time; never overwrites an older run."""
    stem = "".join(letter if letter.isalnum() or letter in "-_." else "_" for letter in recording.stem)
    return f"{stem}-{now:%Y-%m-%d-%H%M%S}"


class FilesPanel:
    """Buttons that open a file browser, and that save, each in the browser that asked for it.

    Args:
        results: folder below which results are saved.
    """

    def __init__(self, page: Page, folders: Folders, results: Path) -> None:
        gui = page.gui
        self._page = page
        self._folders = folders
        self._results = results
        self._open = gui.add_button("Open a recording…", icon=viser.Icon.FOLDER_OPEN, color="gray")
        self._compare = gui.add_button(
            "Compare with a trajectory…",
            icon=viser.Icon.ROUTE,
            color="gray",
            disabled=True,
            hint="Draw the truth, or what another run or program made of this recording, beside the trajectory, and "
            "plot the distance to it.",
        )
        self._save = gui.add_button("Save results…", icon=viser.Icon.DEVICE_FLOPPY, color="gray", disabled=True)
        self._saved = gui.add_html("", visible=False)
        self._open.on_click(by_user(self._browse))
        self._compare.on_click(by_user(self._browse_trajectories))
        self._save.on_click(by_user(lambda _, client: self._ask_where(client)))

    def draw(self, snapshot: Snapshot) -> None:
        """Enable what is possible now; say where the newest results are."""
        self._save.disabled = snapshot.result is None
        self._compare.disabled = snapshot.recording is None or snapshot.live is not None
        done = [saved.folder for saved in snapshot.saved if not saved.error]
        self._saved.visible = bool(done)
        if done:
            self._saved.content = panel("path", "Saved in ", str(done[-1]))

    def _browse(self, _: Any, client: viser.ClientHandle) -> None:
        browser = FileBrowser(client, self._folders, "Open a recording")
        with_truth = browser.checkbox(
            "with truth", "Also load the trajectory (.tum) beside the recording, if there is one."
        )

        def choose(path: Path) -> None:
            path = self._folders.openable(path)
            self._page.send(OpenRecording(path, truth_beside(path) if with_truth.value else None))

        browser.show(RECORDINGS, "No recordings (.bag, .mcap, .db3, .pcap, ROS 2 folders) or sessions here.", choose)

    def _browse_trajectories(self, _: Any, client: viser.ClientHandle) -> None:
        results = [self._results] if self._results.is_dir() else []
        folders = Folders([*self._folders.roots, *results])
        browser = FileBrowser(client, folders, "Compare with a trajectory")
        recording = self._page.snapshot().recording
        if recording is not None and recording.truth is not None:
            browser.button(f"Stop comparing with {recording.truth.name}", lambda: self._page.send(CompareWith(None)))
        browser.show(
            TRAJECTORIES,
            "No trajectories (.tum) here. “Save results…” writes one, as most SLAM programs do.",
            lambda path: self._page.send(CompareWith(folders.inside(path))),
        )

    def _ask_where(self, client: viser.ClientHandle) -> None:
        recording = self._page.snapshot().recording
        if recording is None:
            return
        gui = client.gui
        with dialog(client, "Save results") as close:
            names = [export.name for export in EXPORTS]
            gui.add_html(panel("save", names, f"session{SUFFIX}", str(self._results)))
            name = gui.add_text("folder", result_folder_name(recording.path, datetime.now()))
            everything = gui.add_checkbox("all files", True, hint="Off: only trajectory.tum, which takes no time.")
            problem = gui.add_html("", visible=False)
            save = gui.add_button("Save", icon=viser.Icon.DEVICE_FLOPPY)

        def confirmed(_: object) -> None:
            chosen = Path(name.value.strip())
            if not name.value.strip() or chosen.name != str(chosen) or chosen.name in (".", ".."):
                problem.content = panel("text", "The folder needs a name without /.")
                problem.visible = True
                return
            self._page.send(Save(self._results / chosen, trajectory_only=not everything.value))
            close()

        save.on_click(confirmed)


class FileBrowser:
    """A dialog in one browser to go through folders and choose a file. Add further controls before `show`."""

    def __init__(self, client: viser.ClientHandle, folders: Folders, title: str) -> None:
        self._gui = client.gui
        self._folders = folders
        self._suffixes: tuple[str, ...] = ()
        self._nothing = ""
        self._choose: Callable[[Path], None] = lambda _: None
        self._modal = self._gui.add_modal(title)
        with self._modal:
            self._here = self._gui.add_html("")
            self._list = self._gui.add_folder(None)

    def checkbox(self, label: str, hint: str) -> viser.GuiCheckboxHandle:
        with self._modal:
            return self._gui.add_checkbox(label, True, hint=hint)

    def button(self, text: str, act: Callable[[], None]) -> None:
        """Another way out of the dialog."""
        with self._modal:
            button = self._gui.add_button(text, color="gray")

        def clicked(_: object) -> None:
            act()
            self._modal.close()

        button.on_click(clicked)

    def show(self, suffixes: tuple[str, ...], nothing: str, choose: Callable[[Path], None]) -> None:
        """List the folders.

        Args:
            suffixes: of the files that may be chosen. nothing: shown for a folder without such files.
            choose: called with the file; a HemislamError that it raises is shown.
        """
        self._suffixes, self._nothing, self._choose = suffixes, nothing, choose
        self.button("Cancel", lambda: None)
        roots = self._folders.roots
        self._go(roots[0] if len(roots) == 1 else None)

    def _go(self, folder: Path | None) -> None:
        """List a folder; None lists the roots."""
        order = self._list.order
        self._list.remove()
        with self._modal:
            self._list = self._gui.add_folder(None, order=order)
        with self._list:
            if folder is None:
                self._here.content = panel("text", "Folders that this server was started with:")
                for root in self._folders.roots:
                    self._button(str(root), viser.Icon.FOLDER, partial(self._go, root))
                return
            self._here.content = panel("path", "", str(folder))
            try:
                entries = self._folders.listing(folder, self._suffixes)
            except HemislamError as error:
                self._gui.add_html(panel("path", "", str(error)))
                entries = []
            at_root = folder in self._folders.roots
            if not at_root or len(self._folders.roots) > 1:
                self._button("..", viser.Icon.CORNER_LEFT_UP, lambda: self._go(None if at_root else folder.parent))
            for entry in entries[:_MOST_ENTRIES]:
                self._entry(entry)
            if not entries:
                self._gui.add_html(panel("text", self._nothing))
            if len(entries) > _MOST_ENTRIES:
                more = f"{len(entries) - _MOST_ENTRIES} more are not shown; name the file on the command line."
                self._gui.add_html(panel("text", more))

    def _entry(self, entry: Entry) -> None:
        path = entry.path
        if entry.is_choice:
            self._button(f"{path.name}   {size_text(entry.size)}", viser.Icon.FILE_DATABASE, lambda: self._chosen(path))
        else:
            self._button(path.name, viser.Icon.FOLDER, lambda: self._go(path))

    def _button(self, text: str, icon: viser.IconName, act: Callable[[], None]) -> None:
        self._gui.add_button(text, icon=icon, color="gray").on_click(lambda _: act())

    def _chosen(self, path: Path) -> None:
        try:
            self._choose(path)
        except HemislamError as error:
            self._here.content = panel("path", "", str(error))
            return
        self._modal.close()
