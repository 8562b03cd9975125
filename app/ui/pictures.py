"""Pictures of the scene at any size, and a flight along the path as a series of pictures."""

import io
import threading
import zipfile
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Final

import numpy as np
import viser

from app.server.protocol import Snapshot
from app.slam.errors import HemislamError, writing_to
from app.slam.types import U8
from app.ui.colours import Key
from app.ui.files import result_folder_name, size_text
from app.ui.html import panel
from app.ui.picture_maths import Station, composed, flight
from app.ui.widgets import Changes, Page, add_button, limited, show

_LARGEST: Final = 8192
_MOST_PIXELS: Final = 6144 * 4096
"""Most pixels: the browser's picture must fit into a message (`app.server.access.MOST_OF_PICTURE`)."""
_PATIENCE_S: Final = 120.0
_RATE: Final = 25
"""Pictures per second of a flight."""
_WAYS: Final = {"the walker's eyes": (0.0, 0.0), "behind and above": (5.0, 3.0)}
"""Distance behind the walker and above the path, m."""
_MOST_SENT: Final = 500_000_000


class PicturesPanel:
    """Widgets in the caller's container.

    Args:
        results: folder below which flights are saved. key: the present key of colours, and whether the page is light.
    """

    def __init__(self, page: Page, results: Path, key: Callable[[], tuple[Key, bool]]) -> None:
        gui = page.gui
        self._page, self._results, self._key = page, results, key
        self._flying = threading.Lock()  # held by the thread of the button that began the flight
        self._stopped = threading.Event()
        self._share, self._saved = 0.0, Path()
        self._problem = ""  # why the newest flight ended early; a browser that was reloaded missed the notification
        self._changes = Changes()
        self._width = limited(gui.add_number("width (px)", 1920, min=64, max=_LARGEST, step=1))
        self._height = limited(gui.add_number("height (px)", 1080, min=64, max=_LARGEST, step=1))
        self._explain = gui.add_checkbox("with legend and scale", True)
        add_button(gui, "Take a picture", self._shoot, viser.Icon.CAMERA, hint="A PNG of this view.")
        self._way = gui.add_dropdown("fly with", tuple(_WAYS))
        self._seconds = limited(
            gui.add_number("length (s)", 20.0, min=1.0, max=600.0, step=1.0, hint=f"{_RATE} pictures per second.")
        )
        hint = "Numbered PNGs of this size, in a zip file. Keep this browser tab in front."
        self._start = add_button(gui, "Fly along the path", self._fly, viser.Icon.MOVIE, hint=hint)
        self._progress = gui.add_progress_bar(0.0, visible=False)
        self._stop = add_button(gui, "Stop", lambda _: self.close(), viser.Icon.PLAYER_STOP, visible=False)
        self._where = gui.add_html("")
        self._download = add_button(gui, "Download the flight", self._send, viser.Icon.DOWNLOAD, visible=False)

    def draw(self, snapshot: Snapshot) -> None:
        flying = self._flying.locked()
        self._start.disabled = flying or len(snapshot.trajectory) < 2
        if self._changes(flying, int(100 * self._share), str(self._saved), self._problem):
            self._progress.visible = self._stop.visible = flying
            show(self._progress, 100 * self._share)
            done = not flying and self._saved.is_file()
            self._download.visible = done
            problem = panel("text", self._problem) if self._problem else ""
            self._where.content = problem + (panel("path", "Saved as ", str(self._saved)) if done else "")

    def close(self) -> None:
        """Stop flying."""
        self._stopped.set()

    # --- one picture -----------------------------------------------------------------------------
    def _size(self) -> tuple[int, int]:
        width, height = int(self._width.value), int(self._height.value)
        if width * height > _MOST_PIXELS:
            raise HemislamError(f"{width} × {height} are more pixels than a browser renders; choose a smaller size.")
        return width, height

    def _shoot(self, client: viser.ClientHandle) -> None:
        camera, (key, light) = client.camera, self._key()
        station = Station(np.array(camera.position), np.array(camera.wxyz), camera.fov)
        rendered = self._rendered(client, station)
        away = float(np.linalg.norm(np.array(camera.position) - camera.look_at))
        png = self._png(rendered, key, light, 2 * away * float(np.tan(camera.fov / 2)))
        client.send_file_download(f"{self._name()}.png", png, save_immediately=True)

    def _png(self, rendered: U8, key: Key, light: bool, seen_m: float = 0.0) -> bytes:
        """The picture, with a legend and a scale if wanted. seen_m: as in `composed`."""
        if not self._explain.value:
            key, seen_m = Key(), 0.0
        file = io.BytesIO()
        composed(rendered, key, light=light, seen_m=seen_m).save(file, "PNG", compress_level=3)
        return file.getvalue()

    def _rendered(self, client: viser.ClientHandle, station: Station) -> U8:
        """(h, w, 4) the browser's view from a station. Raises HemislamError: the browser sends no picture."""
        width, height = self._size()
        try:
            rendered: U8 = client.get_render(
                height,
                width,
                position=station.position,
                wxyz=station.wxyz,
                fov=station.fov,
                transport_format="png",
                timeout=_PATIENCE_S,
            )
            return rendered
        except TimeoutError:
            raise HemislamError(
                "The browser sent no picture in time; keep this tab in front, or choose a smaller size."
            ) from None
        except RuntimeError:
            if client.client_id not in self._page.server.get_clients():
                raise HemislamError("The browser tab that rendered was closed or reloaded; start again.") from None
            raise HemislamError("The browser could not render this; choose a smaller size.") from None

    def _name(self) -> str:
        recording = self._page.snapshot().recording
        return result_folder_name(recording.path if recording else Path("map"), datetime.now())

    # --- a flight --------------------------------------------------------------------------------
    def _fly(self, client: viser.ClientHandle) -> None:
        path = self._page.snapshot().trajectory
        if len(path) < 2 or not self._flying.acquire(blocking=False):
            return
        try:
            stations = flight(path, round(_RATE * self._seconds.value), *_WAYS[self._way.value])
            file = self._results / "flights" / f"{self._name()}.zip"
            file.parent.mkdir(parents=True, exist_ok=True)
            self._share, self._problem = 0.0, ""
            self._stopped.clear()
            self._take(client, stations, file)
        except HemislamError as error:
            self._problem = str(error)
            raise
        finally:
            self._flying.release()

    def _take(self, client: viser.ClientHandle, stations: list[Station], file: Path) -> None:
        """Write the pictures one after another. If stopped, leave no file."""
        part, (key, light), session = file.with_suffix(".part"), self._key(), self._page.snapshot().session
        try:
            with writing_to(file.parent), zipfile.ZipFile(part, "w", zipfile.ZIP_STORED) as pictures:
                for number, station in enumerate(stations, 1):
                    here = replace(station, position=station.position + self._page.offset())
                    rendered = self._rendered(client, here)
                    if self._stopped.is_set():
                        return
                    if self._page.snapshot().session != session:
                        raise HemislamError("The map has been replaced, so the flight has ended; start it again.")
                    pictures.writestr(f"{number:05d}.png", self._png(rendered, key, light))
                    self._share = number / len(stations)
            part.replace(file)
            self._saved = file
        finally:
            part.unlink(missing_ok=True)

    def _send(self, client: viser.ClientHandle) -> None:
        size = self._saved.stat().st_size
        if size > _MOST_SENT:
            raise HemislamError(f"{size_text(size)} is too large to download; the file is {self._saved}.")
        client.send_file_download(self._saved.name, self._saved.read_bytes(), save_immediately=True)
