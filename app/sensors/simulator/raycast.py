"""Laser beams that hit the static part of a scene and the bodies that move through it."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from app.sensors.simulator.mesh import Mesh
from app.slam.errors import HemislamError
from app.slam.types import F32, F64, U8


@dataclass(frozen=True, slots=True)
class Mover:
    """A rigid body that walks or drives upright.

    Attributes:
        mesh: in the body's own frame, z up, origin at its foot.
        pose: seconds (n,) -> positions (n, 3) in the world, m, and yaw (n,), rad.
    """

    mesh: Mesh
    pose: Callable[[F64], tuple[F64, F64]]


@dataclass(frozen=True, slots=True)
class SimulatedScene:
    """Attributes:
    mesh: everything static, world frame. movers: moving bodies.
    path: (n, 2) waypoints of the trajectory in plan view, m, or (n, 3) with the floor's z at each.
    closed: whether it is repeated lap by lap. height: z of the ground at (n, 2) points; None: 0, or the path's z.
    """

    mesh: Mesh
    movers: tuple[Mover, ...]
    path: F64
    closed: bool = True
    height: Callable[[F64], F64] | None = None


@dataclass(frozen=True, slots=True)
class Hits:
    """The surfaces hit by n rays. Rays that hit nothing have infinite distance.

    Attributes:
        distance: (n,) m. incidence: (n,) cosine of the angle to the surface normal, 0-1.
        reflectivity: (n,) 0-1. ground: (n,) 1 = floor or terrain.
    """

    distance: F64
    incidence: F32
    reflectivity: F32
    ground: U8


class Raycaster:
    """Casts rays at a scene, each at its own time."""

    def __init__(self, mesh: Mesh, movers: tuple[Mover, ...] = ()) -> None:
        """Raises HemislamError, which names the system packages, if open3d cannot be loaded."""
        self._still = _Target(mesh)
        self._movers = [(mover, _Target(mover.mesh), *_sphere(mover.mesh)) for mover in movers]

    def cast(self, origins: F64, directions: F64, times: F64) -> Hits:
        """Cast rays (n, 3) + s * unit (n, 3) in the world frame, fired at times (n,) s."""
        hits = self._still.cast(origins, directions)
        for mover, target, centre, radius in self._movers:
            where, _ = mover.pose(times[[0, -1]])
            moved = np.linalg.norm(where[1] - where[0]) + np.ptp(origins, axis=0).sum()
            towards = where[0] + [0.0, 0.0, centre] - origins[0]
            near = np.flatnonzero(_passes(directions, towards, radius + float(moved)))
            if not near.size:
                continue
            position, yaw = mover.pose(times[near])
            body = target.cast(_unturned(origins[near] - position, yaw), _unturned(directions[near], yaw))
            closer = body.distance < hits.distance[near]
            into = near[closer]
            for column in fields(Hits):
                getattr(hits, column.name)[into] = getattr(body, column.name)[closer]
        return hits


class _Target:
    """A mesh in open3d's ray casting scene."""

    def __init__(self, mesh: Mesh) -> None:
        self._open3d = _open3d()
        self._mesh = mesh
        self._scene = self._open3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._open3d.core.Tensor(mesh.vertices), self._open3d.core.Tensor(mesh.faces.astype(np.uint32))
        )

    def cast(self, origins: F64, directions: F64) -> Hits:
        rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
        answer = self._scene.cast_rays(self._open3d.core.Tensor(rays))
        distance = answer["t_hit"].numpy().astype(np.float64)
        face = np.where(np.isfinite(distance), answer["primitive_ids"].numpy(), 0).astype(np.int64)
        incidence = np.abs(np.einsum("ni,ni->n", answer["primitive_normals"].numpy(), rays[:, 3:]))
        return Hits(distance, incidence, self._mesh.reflectivity[face], self._mesh.ground[face])


def _open3d() -> Any:
    try:
        import open3d.core
        import open3d.t.geometry
    except (ImportError, OSError) as error:
        raise HemislamError(
            f"The simulator needs open3d, which cannot be loaded here ({error}); "
            "on Debian or Ubuntu: apt-get install libusb-1.0-0 libegl1 libgl1."
        ) from error
    return open3d


def _sphere(mesh: Mesh) -> tuple[float, float]:
    """Centre height and radius of a bounding sphere centred on the axis of an upright body."""
    centre = float(mesh.vertices[:, 2].min() + mesh.vertices[:, 2].max()) / 2
    return centre, float(np.linalg.norm(mesh.vertices - np.array([0.0, 0.0, centre]), axis=1).max()) + 0.01


def _passes(directions: F64, centre: F64, radius: float) -> npt.NDArray[np.bool_]:
    """Mask of the rays from the origin along unit `directions` that come within `radius` of `centre`."""
    along = np.maximum(directions @ centre, 0.0)
    return np.asarray(centre @ centre - along**2 < radius**2)


def _unturned(vectors: F64, yaw: F64) -> F64:
    """Vectors (n, 3) in the frame rotated by `yaw` (n,) about z."""
    c, s = np.cos(yaw), np.sin(yaw)
    x, y, z = vectors.T
    return np.column_stack([c * x + s * y, c * y - s * x, z])
