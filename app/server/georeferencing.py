"""Levels the map of the open session at its end, and georeferences it whenever it is paused and has changed."""

import logging
from concurrent.futures import Future
from typing import NamedTuple

from app.export.results import Results
from app.georeference.survey import Survey
from app.mapping.session import Session
from app.server.protocol import Earth
from app.server.publisher import Publisher
from app.slam.errors import HemislamError
from app.slam.loops.edits import Override
from app.slam.map_frame import MapFrame

log = logging.getLogger(__name__)


class Inputs(NamedTuple):
    """What the work depends on."""

    session: Session | None = None
    survey: Survey | None = None
    overrides: tuple[Override, ...] = ()
    frame: int = -1
    map_frame: MapFrame | None = None


class Georeferencing:
    """Starts the work in a thread of the session and collects its results; one thread calls `update`."""

    def __init__(self, page: Publisher) -> None:
        self._page, self._earth = page, Earth()  # `_earth`: as shown on the page
        self._begun = Inputs()  # of the newest work
        self._under_way: Future[Results] | None = None

    def choose(self, session: Session, survey: Survey | None) -> None:
        """Georeference by this survey from now on. The page shows the choice at once, and the result when available."""
        before = self._earth if self._begun.session is session else Earth()
        session.survey = survey
        source = survey and (survey.gnss, survey.control)
        same = before.survey and (before.survey.gnss, before.survey.control) == source
        self._put(Earth(survey, before.found if same else None))

    def update(self, session: Session, *, still: bool) -> bool:
        """Show new results, and start again if needed. Returns whether work is in progress.

        Args:
            still: whether the session stays at its frame. While it moves, only a choice of the user starts work.
        """
        if self._under_way is not None:
            if not self._under_way.done():
                return True
            self._take(session, self._under_way)
            self._under_way = None
        if session.loops is not None and not session.loops.idle:
            return False
        overrides = tuple(edit for edit in session.edits.done if isinstance(edit, Override))
        before, now = self._begun, Inputs(session, session.survey, overrides, session.frame, session.map_frame)
        others = (before.survey, before.overrides) != (now.survey, now.overrides)
        chosen = others or before.session is not session
        moved = before.frame != now.frame or before.map_frame is not now.map_frame
        if session.frame < 0 or not (chosen or (moved and still and (session.survey is not None or session.ended))):
            return False
        self._begun = now
        if session.survey is None:
            self._show(session, Earth(), _levelling(session))
            return False
        self._under_way = session.georeference()
        return True

    def _take(self, session: Session, work: Future[Results]) -> None:
        """Show the result of the work, unless the choice has changed meanwhile."""
        survey, error = session.survey, work.exception()
        if self._begun.session is not session or self._begun.survey != survey:
            return
        if error is None:
            results = work.result()
            self._show(session, Earth(survey, results.found), results.adjustment)
            return
        if not isinstance(error, HemislamError):
            log.error("The map could not be georeferenced", exc_info=error)
        self._show(session, Earth(survey, problem=str(error) or type(error).__name__), _levelling(session))

    def _show(self, session: Session, earth: Earth, adjustment: MapFrame) -> None:
        if len(adjustment.T_map_odom) or len(session.adjustment.T_map_odom):
            session.adjustment = adjustment
            self._page.map_moved(session)
        self._put(earth)

    def _put(self, earth: Earth) -> None:
        self._earth = earth
        self._page.put(earth=earth, urgent=True)


def _levelling(session: Session) -> MapFrame:
    """Level by the gravity known at the end. Earlier levelling would rotate the map slightly at every stop."""
    return session.levelling(session.map_frame) if session.ended else MapFrame()
