"""How the session is looked at: what every page of it shares and the engine never hears of."""

from dataclasses import dataclass
from typing import Final

from app.ui.colours import ColourBy

STILL_M: Final = 1e-3
"""What moves by no more since it was drawn is not drawn anew: each loop moves most of a walk by some hundredths of a
millimetre."""


@dataclass(frozen=True, slots=True)
class View:
    """Attributes:
    colour_by: what colours mean. point_size: m. follow: keep the sensor in the middle of the page.
    ceilings: draw them too, where a keyframe lies below one. map, scan, wedge, plane, path, grid: whether shown.
    """

    colour_by: ColourBy = ColourBy.LABEL
    point_size: float = 0.02
    follow: bool = True
    ceilings: bool = False
    map: bool = True
    scan: bool = True
    wedge: bool = True
    plane: bool = True
    path: bool = True
    grid: bool = True
