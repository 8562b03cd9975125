"""What a scene is."""

from collections.abc import Callable
from dataclasses import dataclass

from app.sensors.simulator.mesh import Mesh
from app.sensors.simulator.raycast import Mover
from app.slam.types import F64


@dataclass(frozen=True, slots=True)
class Scene:
    """Attributes:
    mesh: everything that stands still, world frame. movers: bodies that move.
    path: (n, 2) waypoints of the walk in plan, m. closed: whether it is walked round and round.
    height: the ground's z at (n, 2) points; None is z = 0.
    """

    mesh: Mesh
    movers: tuple[Mover, ...]
    path: F64
    closed: bool = True
    height: Callable[[F64], F64] | None = None
