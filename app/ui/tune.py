"""Search for better parameters on the open recording, in a process of its own; a click opens a trial as B."""

from pathlib import Path
from typing import Any, Final, get_args

import viser

from app.mapping.painted import marks
from app.server.fork import Workspace
from app.server.protocol import LIVE, Snapshot
from app.slam.errors import HemislamError
from app.tuning.objectives import OBJECTIVES
from app.tuning.process import Ended, Tried, Wanted, find
from app.tuning.trial import SearchMethod, advice
from app.ui import tune_maths as maths
from app.ui.background import Background
from app.ui.compare import Sides
from app.ui.html import panel
from app.ui.viser_adapter import Bridge
from app.ui.widgets import PANEL_PERIOD_S, Changes, Page, add_button

_PARTS: Final = {"5 s from here": 5.0, "20 s from here": 20.0, "60 s from here": 60.0, "the whole recording": None}
_LEAST_S: Final = 5.0
"""A search on a shorter part would show nothing."""
_LABELLED: Final = "the labelled frames"
_NONE: Final = "–"
_TITLES: Final = {one.title: one.name for one in OBJECTIVES.values()}
_EMPTY: Final = (
    "Choose the parameters to vary and the objective, go to a part of the recording that shows the problem, and press "
    "Start. Each trial processes that part with other parameters, without changing this session."
)


class TunePanel:
    """The settings of the search, its progress, and plots of the trials.

    Args:
        folder: for the files that a search writes. sides: shows the parameters of the opened trial.
    """

    def __init__(self, page: Page, forks: Workspace, sides: Sides, folder: Path) -> None:
        gui = page.gui
        self._page, self._forks, self._sides, self._folder = page, forks, sides, folder
        self._wanted: Wanted | None = None  # by the newest search
        self._found, self._chosen = Tried(), -1
        self._failure = ""  # why it ended early; a browser that was reloaded missed the notification
        self._opened = ""  # name of the trial that is B, as long as B has been nothing else
        self._runs: list[tuple[float, int]] = []  # (time, finished runs), since the last run that took no time
        self._changes = Changes(page.now, PANEL_PERIOD_S)
        self._why = gui.add_html("")
        self._parameters = gui.add_text(
            "parameters",
            "ground.alpha, ground.sigma",
            hint="Names as in YAML, each over its full range or a narrower one: ground.alpha=10:40.",
        )
        self._first = gui.add_dropdown("objective", tuple(_TITLES), initial_value=OBJECTIVES["entropy"].title)
        self._second = gui.add_dropdown(
            "and", (_NONE, *_TITLES), hint="With two objectives, the page shows the Pareto front."
        )
        self._part = gui.add_dropdown(
            "on",
            (*_PARTS, _LABELLED),
            initial_value="20 s from here",
            hint="The best are then checked on the next part of the same length.",
        )
        self._search = gui.add_dropdown("search", get_args(SearchMethod), hint="How the next trials are chosen.")
        self._trials = gui.add_slider("trials", 8, 400, 8, 48)
        self._start = add_button(gui, "Start", lambda _: self._begin(), viser.Icon.PLAYER_PLAY, color=None)
        self._go_on = add_button(
            gui, "Continue", lambda _: self._run(), viser.Icon.PLAYER_TRACK_NEXT, color=None, visible=False
        )
        self._work = Background(gui, "tune", "The search", "Finished runs stay.")
        self._bridge = Bridge(gui, "trials", self._clicked)
        self._plots = gui.add_html("")

    def draw(self, snapshot: Snapshot) -> None:
        recording = snapshot.recording.path if snapshot.recording else None
        if self._wanted is not None and recording is not None and recording != self._wanted.recording:
            self.close()
            self._wanted, self._found, self._chosen = None, Tried(), -1
        if self._forks.names[1] != self._opened:
            self._opened = ""  # once it was A, it is the user's
        problem = self._problem(snapshot)
        self._receive()
        running = self._work.running
        self._start.visible, self._start.disabled = not running, bool(problem)
        self._go_on.visible = not running and self._wanted is not None and not self._found.finished
        done = self._runs[-1][1] if self._runs else 0
        if self._changes(self._found, self._chosen, running, done, problem):
            self._why.content = panel("quiet", problem or self._words())
            objectives = self._objectives()
            self._plots.content = self._bridge.live(maths.plots(self._found, objectives, self._chosen))
            if self._wanted is not None:
                self._work.show(min(done / (self._wanted.trials + 1), 1.0))

    def close(self) -> None:
        """Stop a search in progress; its finished runs stay."""
        self._work.stop()

    @staticmethod
    def _problem(snapshot: Snapshot) -> str:
        if snapshot.recording is None:
            return "Open a recording first, under Recording."
        return "A live source cannot be repeated; record it, then open the recording." if snapshot.live else ""

    def _words(self) -> str:
        wanted, found = self._wanted, self._found
        if wanted is None:
            return _EMPTY
        done = f"{len(found.trials)} of {wanted.trials + 1} trials"
        if self._work.running:
            return f"{done} · {self._left(wanted)}" if self._runs else "The first trial uses the given parameters."
        if not found.finished:
            failed = bool(found.trials) and all(trial.error for trial in found.trials)
            why = f"all failed: {found.trials[0].error}" if failed else self._failure
            return " · ".join(filter(None, (done, "stopped", why)))
        best = advice(found.trials, found.held_back, self._objectives())
        return " · ".join(filter(None, (done, f"saved in {wanted.folder}", best)))

    def _left(self, wanted: Wanted) -> str:
        """The time left, estimated from the pace of the newest runs."""
        if len(self._runs) < 2:
            return "the remaining time is not known yet"
        (begin, first), (end, last) = self._runs[-9:][0], self._runs[-1]
        if last > wanted.trials:
            return "checking the best on the part held back"
        return maths.left((end - begin) / (last - first) * (wanted.trials + 1 - last))

    def _objectives(self) -> "list[Any]":
        return [OBJECTIVES[name] for name in self._wanted.objectives] if self._wanted else []

    def _receive(self) -> None:
        for message in self._work.messages():
            match message:
                case Ended(runs, ran):
                    self._runs = [*(self._runs if ran else ()), (self._page.now(), runs)]
                case Tried():
                    self._found = message
                    if message.finished:
                        self.close()
                case sentence:
                    self.close()
                    self._failure = str(sentence)
                    self._page.notify_error(sentence)

    def _begin(self) -> None:
        snapshot = self._page.snapshot()
        if self._work.running or snapshot.recording is None or snapshot.recording.path == LIVE:
            return
        marked = marks(snapshot.painted)
        names = dict.fromkeys(_TITLES[title] for title in (self._first.value, self._second.value) if title != _NONE)
        if snapshot.recording.truth is None and (blind := [one for one in names if OBJECTIVES[one].needs_truth]):
            title = OBJECTIVES[blind[0]].title
            raise HemislamError(f"{title} needs true poses; compare with a truth under Recording, or choose another.")
        if self._part.value == _LABELLED and not marked:
            raise HemislamError("No frame is labelled yet; mark ground in a few frames with the brush under Study.")
        begin, length = self._chosen_part(snapshot, list(marked))
        self._wanted = Wanted(
            snapshot.recording.path,
            snapshot.params,
            snapshot.recording.truth,
            self._parameters.value,
            tuple(names),
            self._search.value,
            int(self._trials.value),
            begin,
            length,
            self._folder,
            tuple((stamp, labels.tobytes()) for stamp, labels in marked.items()) if "ground-f1" in names else (),
        )
        self._run()

    def _chosen_part(self, snapshot: Snapshot, stamps: list[int]) -> tuple[float, float | None]:
        """Start and length of the chosen part, s. stamps: of labelled frames, ascending."""
        assert snapshot.recording is not None
        start_ns = snapshot.recording.start_ns
        if self._part.value == _LABELLED:
            first, last = ((stamp - start_ns) * 1e-9 for stamp in (stamps[0], stamps[-1]))
            begin = round(max(first - 0.15, 0.0), 1)  # before the scan that ends there
            return begin, round(last - begin + 0.2, 1)
        length, here = _PARTS[self._part.value], snapshot.transport.stamp_ns or start_ns
        if length is None:
            return 0.0, None
        begin = round(max((here - start_ns) * 1e-9, 0.0), 1)
        if (left := snapshot.recording.end_s - begin) < _LEAST_S:
            raise HemislamError(
                f"Only {max(left, 0.0):.1f} s of the recording are left from here; go back to a part that shows the "
                "problem, or choose the whole recording."
            )
        return begin, length

    def _run(self) -> None:
        """Begin or continue: a search reuses runs that finished before."""
        if self._wanted is not None and not self._work.running:
            self._found, self._runs, self._chosen, self._failure = Tried(), [], -1, ""
            self._work.begin(find, self._wanted)

    def _clicked(self, word: str, _: viser.ClientHandle) -> None:
        """Handle what the plots send: "trial 12". Open it as B beside the present parameters; the sliders show B's."""
        number = int(word.removeprefix("trial "))
        if not 0 <= number < len(self._found.trials):
            return
        self._chosen = number
        if self._opened and self._forks.names[1] == self._opened:
            self._forks.discard()
        if number:
            self._forks.fork(word, self._found.trials[number].values)
            self._opened = word
            self._sides.choose("B")
