"""Loop commands of the page, and the view of loops that the page gets."""

from dataclasses import replace

from app.mapping.session import Session
from app.server.protocol import EditLoop, InspectLoop, LoopCommand, LoopsView, RedoLoop, TryLoop, UndoLoop
from app.server.publisher import Publisher
from app.slam.loops.edits import Edits
from app.slam.loops.messages import Answered, ApplyEdit, AskResiduals, Failure, Inspect, LoopState, TryOut
from app.slam.loops.schedule import LoopSchedule
from app.slam.loops.types import LoopDetail, Preview


class LoopCommands:
    """Passes commands on to the loops of the open session, and shows the results."""

    def __init__(self, page: Publisher) -> None:
        self._page = page
        self._view = LoopsView()
        self._state: LoopState | None = None

    def clear(self) -> None:
        """Forget everything, since another session begins."""
        self._view, self._state = LoopsView(), None
        self._page.put(loops=self._view)

    def handle(self, command: LoopCommand, loops: LoopSchedule) -> None:
        """Pass a command on; `update` delivers the answer."""
        view = self._view
        match command:
            case EditLoop(edit):
                loops.command(ApplyEdit(edit))
                view = replace(view, tried=None)
            case UndoLoop():
                loops.command(Edits.undo)
            case RedoLoop():
                loops.command(Edits.redo)
            case TryLoop(tried) if tried is not None:
                loops.command(TryOut(tried))
            case TryLoop():
                view = replace(view, tried=None)
            case InspectLoop(pair) if pair is not None:
                loops.command(Inspect(*pair))
            case InspectLoop():
                view = replace(view, inspected=None)
        if command != TryLoop(None):
            loops.command(AskResiduals())  # also for a trial, which is compared with them
        self._show(view)

    def update(self, session: Session, *, show: bool = True) -> bool:
        """Collect answers and, if `show`, show the state in effect. Returns whether answers are pending."""
        loops = session.loops
        if loops is None:
            return False
        loops.poll()
        view = self._view
        for answer in loops.take_answers():
            match answer:
                case Answered(Inspect(older, newer), LoopDetail() as detail):
                    view = replace(view, inspected=((older, newer), detail))
                case Answered(TryOut(command), Preview() as preview):
                    poses = session.adjustment.poses(preview.poses)  # levelled like the shown map
                    view = replace(view, tried=(command, replace(preview, poses=poses)))
                case Answered(AskResiduals(), tuple() as residuals):
                    view = replace(view, residuals=residuals)
                case Failure(text):
                    self._page.notice("error", text)
        for notice in (*loops.take_notices(), *loops.take_alarms()):
            self._page.notice("warning", notice)
        state, moved = loops.state, show and loops.state is not self._state
        self._state = state if show else self._state
        if state is not None and moved:
            if view.edges != state.edges:  # an edge is compared by identity
                view = replace(view, edges=state.edges)
            if (view.undo, view.redo) != (state.undo, state.redo):
                view = replace(view, undo=state.undo, redo=state.redo)
            self._page.map_moved(session)
        self._show(view)
        return not loops.idle

    def _show(self, view: LoopsView) -> None:
        if view is not self._view:
            self._view = view
            self._page.put(loops=view, urgent=True)
