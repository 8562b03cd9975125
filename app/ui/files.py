"""Opening a recording and saving results. The page sees only the folders that the command line allowed."""

import itertools
from collections.abc import Callable
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Final

import viser

from app.export.exports import BY_RUN, EXPORTS, FORMATS
from app.export.points import Choice
from app.mapping.session_file import SUFFIX, SavedSession
from app.server.folders import RECORDINGS, TRAJECTORIES, FolderEntry, Folders
from app.server.protocol import CompareWith, OpenRecording, Restart, Save, Snapshot
from app.slam.errors import HemislamError
from app.slam.text_files import shortened
from app.slam.trajectory import truth_beside
from app.ui.html import panel
from app.ui.nodes import clear
from app.ui.widgets import Changes, Page, add_button, by_user, dialog, limited

_MOST_ENTRIES: Final = 60
_RECENT: Final = 3
_LONGEST_NAME: Final = 200
"""Bytes; file systems allow 255."""
_OF_A_RUN: Final = "all of a run"


def _titles() -> dict[str, str]:
    """Formats by their title on the page, which lists their files and contents."""
    found: dict[str, str] = {}
    for name in FORMATS:
        first, *more = [export for export in EXPORTS if export.format == name]
        files = ", ".join([first.name, *(Path(export.name).suffix for export in more)])
        found[f"{files}: {first.meaning}"] = name
    return found


_FORMATS: Final = _titles()


def size_text(size: int) -> str:
    """A number of bytes in a suitable unit."""
    value = float(size)
    for unit in ("B", "kB", "MB"):
        if value < 1000:
            return f"{value:.0f} {unit}"
        value /= 1000
    return f"{value:.1f} GB"


def result_folder_name(recording: Path, now: datetime) -> str:
    """`hall_bpearl-2026-05-01-134502`: sorts by recording, then by time; never overwrites an older run."""
    stem = "".join(letter if letter.isalnum() or letter in "-_." else "_" for letter in recording.stem)
    return f"{shortened(stem)}-{now:%Y-%m-%d-%H%M%S}"


def last_saved(snapshot: Snapshot) -> Path | None:
    """The folder of the newest results that were saved without an error and stay on the disk."""
    return next((one.folder for one in reversed(snapshot.saved) if not (one.error or one.fetched)), None)


def folder_name(typed: str) -> str:
    """Check a typed name of a results folder. Raises HemislamError: the name cannot be used."""
    name = typed.strip()
    if not name or Path(name).name != name or name.startswith(".") or not name.isprintable():
        raise HemislamError("The folder needs a name without / that does not begin with a dot.")
    if len(name.encode()) > _LONGEST_NAME:
        raise HemislamError("The name is too long for a folder; shorten it.")
    return name


class RecentPanel:
    """Buttons: the last session and, while no recording is open, recent ones; also one that restarts an ended engine.

    Args:
        kept: folder of the session files. browse: asks for a recording.
    """

    def __init__(self, page: Page, folders: Folders, kept: Path, browse: Callable[[viser.ClientHandle], None]) -> None:
        self._send, self._folders, self._kept = page.send, folders, kept
        self._sessions: list[tuple[Path, SavedSession]] = []
        self._changes = Changes()
        self._restart = add_button(
            page.gui, "Start the engine again", lambda _: page.send(Restart()), viser.Icon.REFRESH, visible=False
        )
        self._browse = add_button(
            page.gui, "Open a recording…", browse, viser.Icon.FOLDER_OPEN, color=None, visible=False
        )
        icons = (viser.Icon.HISTORY, *[viser.Icon.FILE_DATABASE] * _RECENT)
        self._buttons = [
            add_button(page.gui, "", partial(self._pick, number), icon, visible=False)
            for number, icon in enumerate(icons)
        ]
        self._offers: list[tuple[str, Path]] = []

    def draw(self, snapshot: Snapshot) -> None:
        recording = snapshot.recording
        nothing = recording is None and snapshot.progress is None
        self._browse.visible, self._restart.visible = nothing and snapshot.engine_alive, not snapshot.engine_alive
        if self._changes(snapshot.session, snapshot.session_file):
            present, found = snapshot.session_file, self._folders.sessions(self._kept)
            own = recording.path.resolve() if recording is not None else None
            self._sessions = [
                (path, saved)
                for path, saved in found
                if (present is None or path.resolve() != present.resolve()) and own in (None, saved.opened.recording)
            ]
        self._offers = []
        if self._sessions and (nothing or (recording is not None and snapshot.live is None)):
            # Offered as long as the recording is open, so that nothing below moves.
            self._buttons[0].hint = f"Open it again: {session_text(self._sessions[0][1])}."
            self._offers = [("Restore last session", self._sessions[0][0])]
        if nothing:
            recent = dict.fromkeys(saved.opened.recording for _, saved in self._sessions)
            self._offers += [(f"Open {path.name}", path) for path in list(recent)[:_RECENT]]
        for button, offer in itertools.zip_longest(self._buttons, self._offers):
            button.visible = offer is not None
            if offer is not None:
                button.label = offer[0]

    def _pick(self, number: int, _: viser.ClientHandle) -> None:
        if number < len(self._offers):
            path = self._offers[number][1]
            self._send(OpenRecording(path, truth_beside(path)))


def session_text(saved: SavedSession) -> str:
    """How far a session got, and how many edits and notes the user made."""
    counts = {"loop edit": len(saved.state.edits), "note": len(saved.state.notes)}
    done = [f"{count} {name}{'s' if count > 1 else ''}" for name, count in counts.items() if count]
    return ", ".join([saved.opened.recording.name, f"frame {saved.frame:,}", *done])


class FilesPanel:
    """Buttons that open a file browser or save results, each in the browser where it was clicked.

    Args:
        results: folder below which results are saved.
    """

    def __init__(self, page: Page, folders: Folders, results: Path) -> None:
        self._page = page
        self._folders = folders
        self._results = results

    def add_buttons(self) -> None:
        """Add the buttons to the present container."""
        gui = self._page.gui
        add_button(gui, "Open a recording…", self.browse, viser.Icon.FOLDER_OPEN)
        self._compare = add_button(
            gui,
            "Compare with a trajectory…",
            self._browse_trajectories,
            viser.Icon.ROUTE,
            disabled=True,
            hint="Draw the truth, or the result of another run or program, beside the trajectory, and "
            "plot the distance to it.",
        )
        self._save = add_button(gui, "Save results…", self.ask_where, viser.Icon.DEVICE_FLOPPY, disabled=True)
        self._saved = gui.add_html("")
        self._download = add_button(gui, "Download…", self._offer, viser.Icon.DOWNLOAD, visible=False)

    def draw(self, snapshot: Snapshot) -> None:
        self._save.disabled = snapshot.transport.frame < 0
        self._compare.disabled = snapshot.recording is None or snapshot.live is not None
        folder = last_saved(snapshot)
        self._download.visible = folder is not None
        self._saved.content = panel("path", "Saved in ", str(folder)) if folder is not None else ""

    def browse(self, client: viser.ClientHandle) -> None:
        def choose(path: Path) -> None:
            path = self._folders.openable(path)
            self._page.send(OpenRecording(path, truth_beside(path) if with_truth.value else None))

        with dialog(client, "Open a recording") as close:
            nothing = "No recordings (.bag, .mcap, .db3, .pcap, ROS 2 folders) or sessions here."
            FileList(client.gui, self._folders, RECORDINGS, nothing, choose, close)
            with_truth = client.gui.add_checkbox(
                "with truth", True, hint="Also load the trajectory (.tum) beside the recording, if there is one."
            )

    def _browse_trajectories(self, client: viser.ClientHandle) -> None:
        folders = self._folders.and_also(self._results)
        recording, gui = self._page.snapshot().recording, client.gui

        def stop(_: object) -> None:
            self._page.send(CompareWith(None))
            close()

        with dialog(client, "Compare with a trajectory") as close:
            nothing = "No trajectories (.tum) here. “Save results…” writes one, as most SLAM programs do."
            FileList(
                gui,
                folders,
                TRAJECTORIES,
                nothing,
                lambda path: self._page.send(CompareWith(folders.inside(path))),
                close,
            )
            if recording is not None and recording.truth is not None:
                gui.add_button(f"Stop comparing with {recording.truth.name}", color="gray").on_click(stop)

    def _offer(self, client: viser.ClientHandle) -> None:
        """List the files of the newest saved results; a click downloads one."""
        folder = last_saved(self._page.snapshot())
        if folder is None or not folder.is_dir():
            raise HemislamError(f"The folder {folder} is gone; save the results again.")
        files = sorted(path for path in folder.iterdir() if path.is_file())
        with dialog(client, "Download results"):
            for path in files:
                text = f"{path.name}   {size_text(path.stat().st_size)}"
                add_button(client.gui, text, partial(_send_file, path), viser.Icon.DOWNLOAD)

    def ask_where(self, client: viser.ClientHandle, format: str = "") -> None:
        """Ask for a folder, the files and the choice of points, and save. format: one of `FORMATS`, the preset."""
        recording, clip = self._page.snapshot().recording, self._page.snapshot().clip
        if recording is None:
            return
        gui = client.gui
        with dialog(client, "Save results") as close:
            names = [export.name for export in BY_RUN]
            of_a_run = gui.add_html(panel("save", names, f"session{SUFFIX}", str(self._results)), visible=not format)
            name = gui.add_text("folder", result_folder_name(recording.path, datetime.now()))
            titles = {name: title for title, name in _FORMATS.items()}
            files = gui.add_dropdown(
                "files",
                (_OF_A_RUN, *_FORMATS),
                initial_value=titles.get(format, _OF_A_RUN),
                hint="All files of a run, or one file for other programs.",
            )
            thin = limited(
                gui.add_number(
                    "thin to (m)",
                    0.0,
                    min=0.0,
                    max=100.0,
                    step=0.01,
                    hint="One point in each voxel of this size; 0: all.",
                )
            )
            boxed = gui.add_checkbox(
                "inside the clip box", clip.on, visible=clip.box is not None, hint="Only points inside it."
            )
            moving = gui.add_checkbox(
                "with moving points", True, hint="Marked in PLY, PCD, LAS and LAZ; other formats omit them."
            )
            add_button(gui, "Save", lambda _: confirmed(), viser.Icon.DEVICE_FLOPPY, color=None)

        def confirmed() -> None:
            now = self._page.snapshot()
            if now.recording is None or now.recording.path != recording.path:
                raise HemislamError("Another recording is open now; cancel, and save its results instead.")
            formats = (_FORMATS[files.value],) if files.value in _FORMATS else ()
            choice = Choice(thin.value, now.clip.box if boxed.value else None, now.clip.slab, moving.value)
            self._page.send(Save(self._results / folder_name(name.value), formats, choice))
            close()

        files.on_update(by_user(lambda chosen, _: setattr(of_a_run, "visible", chosen == _OF_A_RUN)))


def _send_file(path: Path, client: viser.ClientHandle) -> None:
    client.send_file_download(path.name, path.read_bytes(), save_immediately=True)


class FileList:
    """A file browser in a dialog: folders to open and files to choose.

    Args:
        suffixes: of the files that may be chosen. nothing: shown for a folder without such files.
        choose: called with the file, and then `close`; if `choose` raises a HemislamError, the dialog stays.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        folders: Folders,
        suffixes: tuple[str, ...],
        nothing: str,
        choose: Callable[[Path], None],
        close: Callable[[], None],
    ) -> None:
        self._gui, self._folders, self._suffixes, self._nothing = gui, folders, suffixes, nothing
        self._choose, self._close = choose, close
        self._here = gui.add_html("")
        self._place = gui.add_folder(None)
        self._rows: list[viser.GuiButtonHandle | viser.GuiHtmlHandle] = []
        self._go(folders.roots[0] if len(folders.roots) == 1 else None)

    def _go(self, folder: Path | None) -> None:
        """List a folder; None lists the roots."""
        clear(self._rows)
        roots = self._folders.roots
        if folder is None:
            self._here.content = panel("text", "Folders that this server was started with:")
            for root in roots:
                self._button(str(root), viser.Icon.FOLDER, partial(self._go, root))
            return
        self._here.content = panel("path", "", str(folder))
        entries: list[FolderEntry] = []
        try:
            entries = self._folders.listing(folder, self._suffixes)
        except HemislamError as error:
            self._text(panel("path", "", str(error)))
        if folder not in roots or len(roots) > 1:
            above = None if folder in roots else folder.parent
            self._button("..", viser.Icon.CORNER_LEFT_UP, partial(self._go, above))
        for entry in entries[:_MOST_ENTRIES]:
            if entry.outside:
                words = " leads out of these folders. To open it, start hemislam with --folder and the folder it is in."
                self._text(panel("path", "", entry.path.name, words))
            elif entry.is_choice:
                text = f"{entry.path.name}   {size_text(entry.size)}"
                self._button(text, viser.Icon.FILE_DATABASE, partial(self._chosen, entry.path))
            else:
                self._button(entry.path.name, viser.Icon.FOLDER, partial(self._go, entry.path))
        if not entries:
            self._text(panel("text", self._nothing))
        if len(entries) > _MOST_ENTRIES:
            more = f"{len(entries) - _MOST_ENTRIES} more are not shown; name the file on the command line."
            self._text(panel("text", more))

    def _text(self, html: str) -> None:
        with self._place:
            self._rows.append(self._gui.add_html(html))

    def _button(self, text: str, icon: viser.IconName, act: Callable[[], None]) -> None:
        with self._place:
            self._rows.append(add_button(self._gui, text, lambda _: act(), icon))

    def _chosen(self, path: Path) -> None:
        self._choose(path)
        self._close()
