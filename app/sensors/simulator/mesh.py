"""Triangle meshes with the surface properties that matter to a laser, and the solids from which scenes are built.

World frame: x, y level, z up, metres.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.slam.types import F32, F64, U8

Faces = npt.NDArray[np.int32]
Triple = Sequence[float] | F64
"""A point or direction, 2 or 3 numbers."""

_BOX_CORNERS: F64 = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_BOX_FACES: Faces = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ],
    dtype=np.int32,
)


@dataclass(frozen=True, slots=True)
class Mesh:
    """Attributes:
    vertices: (v, 3) float32, m. faces: (f, 3) int32.
    reflectivity: (f,) float32, diffuse, 0-1. ground: (f,) uint8, 1 = floor or terrain.
    """

    vertices: F32
    faces: Faces
    reflectivity: F32
    ground: U8


class MeshBuilder:
    """Collects solids; `build` returns the mesh. Angles are in radians, yaw is about +z."""

    def __init__(self) -> None:
        self._vertices: list[F64] = []
        self._faces: list[Faces] = []
        self._reflectivity: list[F32] = []
        self._ground: list[U8] = []
        self._count = 0

    def add(
        self, vertices: F64, faces: npt.NDArray[np.integer], reflectivity: float | F32, ground: bool = False
    ) -> None:
        """Any triangles: vertices (v, 3), faces (f, 3) of vertex indices; reflectivity for all or for each face."""
        self._vertices.append(np.asarray(vertices, np.float64))
        self._faces.append((faces + self._count).astype(np.int32))
        self._reflectivity.append(np.broadcast_to(np.float32(reflectivity), len(faces)).astype(np.float32))
        self._ground.append(np.full(len(faces), ground, np.uint8))
        self._count += len(vertices)

    def build(self) -> Mesh:
        return Mesh(
            np.concatenate(self._vertices).astype(np.float32),
            np.concatenate(self._faces),
            np.concatenate(self._reflectivity),
            np.concatenate(self._ground),
        )

    def place(self, mesh: Mesh, at: Triple) -> None:
        """A finished mesh, moved but not rotated."""
        for ground in (0, 1):
            which = mesh.ground == ground
            self.add(mesh.vertices + np.asarray(at), mesh.faces[which], mesh.reflectivity[which], bool(ground))

    def quad(self, corners: Sequence[Sequence[float]], reflectivity: float, ground: bool = False) -> None:
        """A quadrilateral: four corners in order around it."""
        self.add(np.array(corners, np.float64), np.array([[0, 1, 2], [0, 2, 3]]), reflectivity, ground)

    def box(self, centre: Triple, size: Triple, reflectivity: float, yaw: float = 0.0, tilt: float = 0.0) -> None:
        """A closed box; `tilt` rotates it about its own x axis before the yaw."""
        c, s = np.cos(tilt), np.sin(tilt)
        corners = (_BOX_CORNERS * np.asarray(size)) @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]).T
        self.add(_turned(corners, yaw) + np.asarray(centre), _BOX_FACES, reflectivity)

    def boxes(self, centres: Iterable[Triple], size: Triple, reflectivity: float, yaw: float = 0.0) -> None:
        """Equal boxes at several places."""
        for centre in centres:
            self.box(centre, size, reflectivity, yaw)

    def cylinder(
        self,
        base: Triple,
        radius: float,
        height: float,
        reflectivity: float,
        top_radius: float | None = None,
        sides: int = 14,
    ) -> None:
        """An upright closed cylinder or cone frustum standing on `base`."""
        angles = np.linspace(0, 2 * np.pi, sides, endpoint=False)
        ring = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(sides)])
        top = radius if top_radius is None else top_radius
        axis = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, height]])
        vertices = np.vstack([ring * radius, ring * top + axis[1], axis])
        i = np.arange(sides)
        j = (i + 1) % sides
        bottom = np.column_stack([j, i, np.full(sides, 2 * sides)])
        lid = np.column_stack([i + sides, j + sides, np.full(sides, 2 * sides + 1)])
        self.add(vertices + np.asarray(base), np.vstack([band_faces(sides), bottom, lid]), reflectivity)

    def ellipsoid(self, centre: Triple, radii: Triple, reflectivity: float, yaw: float = 0.0) -> None:
        u = np.linspace(0, 2 * np.pi, 13)
        v = np.linspace(-np.pi / 2, np.pi / 2, 8)
        uu, vv = np.meshgrid(u, v, indexing="ij")
        points = np.stack([np.cos(uu) * np.cos(vv), np.sin(uu) * np.cos(vv), np.sin(vv)], axis=-1).reshape(-1, 3)
        vertices = _turned(points * np.asarray(radii), yaw) + np.asarray(centre)
        self.add(vertices, _grid_faces(len(u), len(v)), reflectivity)

    def leaves(
        self,
        centre: Triple,
        radii: Triple,
        count: int,
        size: float,
        reflectivity: float,
        rng: np.random.Generator,
    ) -> None:
        """Foliage: small triangles in random orientations in an ellipsoid, denser at its surface."""
        directions = rng.normal(size=(count, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        middles = directions * rng.uniform(0.3, 1.0, (count, 1)) ** 0.5 * np.asarray(radii) + np.asarray(centre)
        corners = middles[:, None, :] + rng.normal(scale=size, size=(count, 3, 3))
        shade = (reflectivity * rng.uniform(0.8, 1.2, count)).astype(np.float32)
        self.add(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), shade)

    def surface(self, x: F64, y: F64, height: Callable[[F64], F64], reflectivity: Callable[[F64], F64]) -> None:
        """Ground as a height field over the grid x by y; `height` and `reflectivity` take (n, 2) and give (n,)."""
        xx, yy = np.meshgrid(x, y, indexing="ij")
        plan = np.column_stack([xx.ravel(), yy.ravel()])
        vertices = np.column_stack([plan, height(plan)])
        faces = _grid_faces(len(x), len(y))
        middles = vertices[faces].mean(axis=1)[:, :2]
        self.add(vertices, faces, reflectivity(middles).astype(np.float32), ground=True)

    def wall(
        self,
        start: Triple,
        end: Triple,
        height: float,
        reflectivity: float,
        openings: Sequence[tuple[float, float, float, float]] = (),
        thickness: float = 0.15,
        base: float = 0.0,
    ) -> None:
        """An upright wall along a line in plan view, with rectangular openings.

        Args:
            start, end: (x, y) of the wall's middle line.
            openings: (from, to, bottom, top), each in metres along the wall and above its base.
        """
        a, along, length, yaw = line_through(start, end)

        def piece(s0: float, s1: float, z0: float, z1: float) -> None:
            if s1 - s0 > 1e-6 and z1 - z0 > 1e-6:
                middle = a + along * (s0 + s1) / 2
                self.box((*middle, base + (z0 + z1) / 2), (s1 - s0, thickness, z1 - z0), reflectivity, yaw)

        s = 0.0
        for s0, s1, z0, z1 in sorted(openings):
            piece(s, s0, 0.0, height)
            piece(s0, s1, 0.0, z0)
            piece(s0, s1, z1, height)
            s = s1
        piece(s, length, 0.0, height)


def band_faces(count: int) -> Faces:
    """The faces between a ring of `count` vertices and an equal ring of the following vertices."""
    i = np.arange(count, dtype=np.int32)
    j = (i + 1) % count
    return np.vstack([np.column_stack([i, j, j + count]), np.column_stack([i, j + count, i + count])])


def line_through(start: Triple, end: Triple) -> tuple[F64, F64, float, float]:
    """Start, unit direction, length and yaw of a line in plan view."""
    a, b = np.asarray(start, np.float64), np.asarray(end, np.float64)
    length = float(np.linalg.norm(b - a))
    along = (b - a) / length
    return a, along, length, float(np.arctan2(along[1], along[0]))


def _turned(points: F64, yaw: float) -> F64:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.asarray(points @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T)


def _grid_faces(rows: int, columns: int) -> Faces:
    """Two triangles for each cell of a grid of vertices numbered row by row."""
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
    a = (i * columns + j).ravel()
    faces = np.vstack(
        [np.column_stack([a, a + columns, a + columns + 1]), np.column_stack([a, a + columns + 1, a + 1])]
    )
    return faces.astype(np.int32)
