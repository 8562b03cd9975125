"""The fixes or control points that georeference a map, as a session stores them."""

from dataclasses import dataclass
from pathlib import Path

from pydantic import FiniteFloat

from app.slam.arrays import Vector


@dataclass(frozen=True, slots=True)
class Pick:
    """The place of a control point relative to a keyframe, so that it moves with the map.

    Attributes:
        at: m, in the keyframe's IMU frame. frame: of the keyframe, since other settings choose others; -1: unknown.
    """

    name: str
    keyframe: int
    at: Vector
    frame: int = -1


@dataclass(frozen=True, slots=True)
class Survey:
    """Satellite fixes, or control points if there is a table of them.

    Attributes:
        gnss: file of fixes; None: those of the recording. control: text of a table of control points.
        picks: where these are in the map. crs: "EPSG:code" of a projected system; "": the UTM zone there.
        height: what heights are above; "": as the fixes say. lever: m from the IMU to the antenna, IMU frame; None:
            estimated, if the motion allows. offset_s: how much later fixes are stamped than measured; None: estimated.
        factors: whether the fixes bend the map.
    """

    gnss: Path | None = None
    control: str = ""
    picks: tuple[Pick, ...] = ()
    crs: str = ""
    height: str = ""
    lever: Vector | None = None
    offset_s: FiniteFloat | None = None
    factors: bool = False
