"""How the session is looked at: shared by every browser, unknown to the engine."""

from dataclasses import dataclass

from app.ui.colours import LABEL


@dataclass(frozen=True, slots=True)
class View:
    """Attributes:
    colour_by: a name of `app.ui.colours.COLOUR_BY`. point_size: m. follow: keep the sensor in the middle of the page.
    ceilings: show points above the ceiling too. map, scan, wedge, plane, path, grid: whether shown.
    """

    colour_by: str = LABEL
    point_size: float = 0.02
    follow: bool = True
    ceilings: bool = False
    map: bool = True
    scan: bool = True
    wedge: bool = True
    plane: bool = True
    path: bool = True
    grid: bool = True
