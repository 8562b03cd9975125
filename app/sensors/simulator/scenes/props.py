"""Parts of scenes: floors and walls, furniture, plants, vehicles and people.

Sizes are in metres, `at` is (x, y, floor z), yaw is in radians.
"""

from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise, product

import numpy as np
from scipy.interpolate import make_interp_spline

from app.sensors.simulator.mesh import Mesh, MeshBuilder, Triple, band_faces
from app.sensors.simulator.raycast import Mover
from app.slam.metrics import walked_m
from app.slam.types import F64

Point = tuple[float, float]
Corners = Sequence[Point] | F64
"""A polygon or polyline in plan view, m."""


def rectangle(x0: float, y0: float, x1: float, y1: float) -> list[Point]:
    """Corners, counter-clockwise."""
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]


def sides(corners: Sequence[Point]) -> list[tuple[Point, Point]]:
    """Start and end of each side of a closed polygon."""
    return list(pairwise([*corners, corners[0]]))


def grid(xs: Iterable[float], ys: Iterable[float], z: float) -> list[tuple[float, float, float]]:
    """All places with these x and y, at one height."""
    return [(x, y, z) for x, y in product(xs, ys)]


def on_ground(height: Callable[[F64], F64]) -> Callable[[float, float], tuple[float, float, float]]:
    """A function from (x, y) to the point of the terrain there."""
    return lambda x, y: (x, y, float(height(np.array([[x, y]]))[0]))


def level(xy: F64) -> F64:
    """The height of a flat floor."""
    return np.zeros(len(xy))


def tiled(reflectivity: float, size: float = 0.6) -> Callable[[F64], F64]:
    """The reflectivity of floor tiles; every other tile is slightly brighter."""

    def shade(xy: F64) -> F64:
        odd = np.floor(xy / size).sum(axis=1) % 2
        return np.asarray(reflectivity * (1.0 + 0.2 * odd))

    return shade


def storey(
    mesh: MeshBuilder, corners: Sequence[Point], height: float, step: float, floor: Callable[[F64], F64], ceiling: float
) -> None:
    """A floor with a grid of `step`, and the ceiling above it; no walls."""
    (x0, y0), (x1, y1) = corners[0], corners[2]
    mesh.surface(np.arange(x0, x1 + 0.01, step), np.arange(y0, y1 + 0.01, step), level, floor)
    mesh.quad([(x, y, height) for x, y in corners], ceiling)


def _place(at: Triple, yaw: float) -> Callable[[float, float, float], tuple[float, float, float]]:
    """Convert a prop's own coordinates to world coordinates."""
    c, s = float(np.cos(yaw)), float(np.sin(yaw))
    return lambda x, y, z: (at[0] + c * x - s * y, at[1] + s * x + c * y, at[2] + z)


def table(mesh: MeshBuilder, at: Triple, yaw: float = 0.0, size: tuple[float, float, float] = (1.6, 0.8, 0.74)) -> None:
    p = _place(at, yaw)
    length, width, height = size
    mesh.box(p(0, 0, height - 0.02), (length, width, 0.04), 0.55, yaw)
    legs = grid((-length / 2 + 0.06, length / 2 - 0.06), (-width / 2 + 0.06, width / 2 - 0.06), (height - 0.04) / 2)
    mesh.boxes([p(*leg) for leg in legs], (0.06, 0.06, height - 0.04), 0.35, yaw)


def chair(mesh: MeshBuilder, at: Triple, yaw: float = 0.0) -> None:
    """A chair with its back at -x."""
    p = _place(at, yaw)
    mesh.box(p(0, 0, 0.45), (0.45, 0.45, 0.05), 0.4, yaw)
    mesh.box(p(-0.21, 0, 0.72), (0.04, 0.45, 0.5), 0.4, yaw)
    mesh.boxes([p(*leg) for leg in grid((-0.19, 0.19), (-0.19, 0.19), 0.21)], (0.04, 0.04, 0.43), 0.3, yaw)


def shelf(
    mesh: MeshBuilder, at: Triple, yaw: float, rng: np.random.Generator, size: tuple[float, float] = (1.2, 2.0)
) -> None:
    """A shelf with books, open towards +x."""
    p = _place(at, yaw)
    width, height = size
    mesh.box(p(-0.16, 0, height / 2), (0.02, width, height), 0.5, yaw)
    mesh.boxes([p(0, y, height / 2) for y in (-width / 2, width / 2)], (0.32, 0.03, height), 0.5, yaw)
    for z in np.arange(0.1, height + 0.01, 0.38):
        mesh.box(p(0, 0, z), (0.32, width, 0.03), 0.5, yaw)
        y = -width / 2 + 0.05
        while y < width / 2 - 0.1 and z < height - 0.3:
            thick = rng.uniform(0.02, 0.09)
            mesh.box(p(-0.02, y + thick / 2, z + 0.15), (0.2, thick, rng.uniform(0.2, 0.3)), rng.uniform(0.1, 0.8), yaw)
            y += thick + (0.0 if rng.random() < 0.8 else 0.15)


def sofa(mesh: MeshBuilder, at: Triple, yaw: float = 0.0) -> None:
    """A sofa with its back at -x."""
    p, width = _place(at, yaw), 1.9
    mesh.box(p(0, 0, 0.22), (0.85, width, 0.44), 0.3, yaw)
    mesh.box(p(-0.36, 0, 0.55), (0.2, width, 0.5), 0.3, yaw)
    mesh.boxes([p(0, y, 0.32) for y in (-width / 2, width / 2)], (0.85, 0.18, 0.64), 0.28, yaw)


def plant(mesh: MeshBuilder, at: Triple, rng: np.random.Generator) -> None:
    mesh.cylinder(at, 0.18, 0.4, 0.25, top_radius=0.23)
    mesh.leaves((at[0], at[1], at[2] + 0.9), (0.4, 0.4, 0.5), 160, 0.05, 0.5, rng)


def extinguisher(mesh: MeshBuilder, at: Triple) -> None:
    mesh.cylinder((at[0], at[1], at[2] + 0.5), 0.08, 0.5, 0.6)
    mesh.cylinder((at[0], at[1], at[2] + 1.0), 0.03, 0.1, 0.2)


def sculpture(mesh: MeshBuilder, at: Triple, rng: np.random.Generator) -> None:
    """A sculpture: three ellipsoids on a plinth."""
    x, y, floor = at
    mesh.box((x, y, floor + 0.45), (0.7, 0.7, 0.9), 0.7, rng.uniform(0, 0.6))
    for z in (1.15, 1.55, 1.85):
        shift = rng.uniform(-0.08, 0.08, 2)
        radii = rng.uniform(0.14, 0.3, 3) * (2.2 - z)
        mesh.ellipsoid((x + shift[0], y + shift[1], floor + z), radii + 0.08, 0.75, rng.uniform(0, np.pi))


def door_leaf(mesh: MeshBuilder, hinge: Triple, yaw: float, width: float = 0.9, height: float = 2.1) -> None:
    """A door leaf that extends from its hinge along +x of `yaw`, with a handle on either side."""
    p = _place(hinge, yaw)
    mesh.box(p(width / 2, 0, height / 2), (width, 0.04, height), 0.5, yaw)
    mesh.box(p(width - 0.1, 0, 1.05), (0.12, 0.14, 0.03), 0.25, yaw)


def tree(mesh: MeshBuilder, at: Triple, rng: np.random.Generator, height: float = 7.0) -> None:
    trunk = height * rng.uniform(0.3, 0.4)
    mesh.cylinder((at[0], at[1], at[2] - 0.3), 0.025 * height, trunk + 0.3 + height * 0.2, 0.25, top_radius=0.08)
    crown = (height - trunk) / 2
    for _ in range(4):
        shift = rng.normal(scale=0.35 * crown, size=3) * [1, 1, 0.5]
        centre = np.array([at[0], at[1], at[2] + trunk + crown]) + shift
        mesh.leaves(centre, crown * rng.uniform(0.5, 0.8, 3), 220, 0.09, 0.45, rng)


def bush(mesh: MeshBuilder, at: Triple, rng: np.random.Generator, size: float = 0.9) -> None:
    mesh.leaves((at[0], at[1], at[2] + 0.4 * size), (size, size, 0.6 * size), 320, 0.06, 0.45, rng)


def hedge(mesh: MeshBuilder, start: Triple, end: Triple, rng: np.random.Generator, height: float = 1.0) -> None:
    a, b = np.asarray(start, np.float64), np.asarray(end, np.float64)
    for share in np.arange(0.0, 1.0, 0.7 / float(np.linalg.norm(b - a))):
        middle = a + (b - a) * share + [0, 0, height / 2]
        mesh.leaves(middle, (0.5, 0.5, height / 2), 200, 0.06, 0.45, rng)


def car(mesh: MeshBuilder, at: Triple, yaw: float, rng: np.random.Generator) -> None:
    p = _place(at, yaw)
    paint = rng.uniform(0.1, 0.7)
    side = np.array(
        [(-2.1, 0.3), (-2.15, 0.85), (-1.6, 0.95), (-1.1, 1.42), (0.45, 1.45), (1.1, 0.98), (2.0, 0.8), (2.15, 0.35)]
    )
    count = len(side)
    vertices = np.array([p(x, y, z) for y in (-0.87, 0.87) for x, z in side])
    fan = np.array([[0, k, k + 1] for k in range(1, count - 1)])
    mesh.add(vertices, np.vstack([band_faces(count), fan, fan + count]), paint)
    for wheel in grid((-1.3, 1.35), (-0.8, 0.8), 0.32):
        mesh.ellipsoid(p(*wheel), (0.32, 0.12, 0.32), 0.08, yaw)


def bench(mesh: MeshBuilder, at: Triple, yaw: float = 0.0) -> None:
    p = _place(at, yaw)
    mesh.box(p(0, 0, 0.44), (0.45, 1.6, 0.06), 0.5, yaw)
    mesh.box(p(-0.25, 0, 0.72), (0.05, 1.6, 0.3), 0.5, yaw)
    mesh.boxes([p(0, y, 0.2) for y in (-0.65, 0.65)], (0.4, 0.08, 0.42), 0.3, yaw)


def lamp_post(mesh: MeshBuilder, at: Triple, height: float = 4.5) -> None:
    mesh.cylinder((at[0], at[1], at[2] - 0.3), 0.07, height + 0.3, 0.4, top_radius=0.04)
    mesh.ellipsoid((at[0], at[1], at[2] + height), (0.25, 0.25, 0.18), 0.7)


def person_mesh(height: float = 1.75) -> Mesh:
    """A person in mid-stride, facing +x."""
    mesh = MeshBuilder()
    scale = height / 1.75
    mesh.ellipsoid((0, 0, 1.63 * scale), (0.1, 0.08, 0.12), 0.4)
    mesh.ellipsoid((0, 0, 1.2 * scale), (0.14, 0.21, 0.34), 0.3)
    mesh.ellipsoid((0, 0, 0.92 * scale), (0.13, 0.18, 0.17), 0.2)
    for side, swing in ((-1, 0.3), (1, -0.3)):
        for z, tilt_x in ((0.68, 0.11), (0.25, 0.26)):
            mesh.ellipsoid((np.sign(swing) * tilt_x, side * 0.1, z * scale), (0.08, 0.08, 0.26), 0.2)
        mesh.ellipsoid((-np.sign(swing) * 0.12, side * 0.24, 1.05 * scale), (0.06, 0.05, 0.3), 0.3)
    return mesh.build()


def pedestrian(
    corners: Corners, speed: float, start: float = 0.0, height: Callable[[F64], F64] | None = None, size: float = 1.75
) -> Mover:
    """A person who endlessly walks round a closed polygon, `start` metres along it at time 0."""
    path = _rounded(np.array(corners, np.float64))
    loop = np.vstack([path, path[:1]])
    arc = walked_m(loop)
    curve = make_interp_spline(arc, loop, k=3, bc_type="periodic")
    tangent = curve.derivative()

    def pose(t: F64) -> tuple[F64, F64]:
        s = (start + speed * t) % arc[-1]
        xy = curve(s)
        ahead = tangent(s)
        z = np.zeros(len(t)) if height is None else height(xy)
        return np.column_stack([xy, z]), np.arctan2(ahead[:, 1], ahead[:, 0])

    return Mover(person_mesh(size), pose)


def _rounded(outline: F64) -> F64:
    """(n, 2) waypoints a metre apart round a closed polygon with cut corners."""
    points: list[F64] = []
    for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        length = float(np.linalg.norm(b - a))
        points.extend(a + (b - a) / length * s for s in np.arange(0.7, length - 0.5, 1.0))
    return np.array(points)


def building(mesh: MeshBuilder, at: Triple, size: Triple, yaw: float = 0.0) -> None:
    """A building with rows of windows, a plinth and a gabled roof; its walls reach 2 m below `at`, for slopes."""
    p = _place(at, yaw)
    length, depth, height = size
    mesh.box(p(0, 0, height / 2 - 1.0), (length, depth, height + 2.0), 0.4, yaw)
    mesh.box(p(0, 0, -0.7), (length + 0.2, depth + 0.2, 2.6), 0.3, yaw)
    for z in np.arange(2.0, height - 1.0, 3.0):
        for x in np.arange(-length / 2 + 1.6, length / 2 - 1.0, 2.6):
            for y in (-depth / 2, depth / 2):
                mesh.box(p(x, y, z), (1.2, 0.06, 1.5), 0.03, yaw)
                mesh.box(p(x, y * (1 + 0.14 / depth), z - 0.8), (1.4, 0.16, 0.08), 0.5, yaw)
        for y in np.arange(-depth / 2 + 1.6, depth / 2 - 1.0, 2.6):
            mesh.boxes([p(x, y, z) for x in (-length / 2, length / 2)], (0.06, 1.2, 1.5), 0.03, yaw)
    eave, ridge = height, height + 0.3 * min(length, depth)
    a, b = length / 2 + 0.4, depth / 2 + 0.4
    along = (length / 2 - 0.2, 0.0) if length > depth else (0.0, depth / 2 - 0.2)
    corners = [p(-a, -b, eave), p(a, -b, eave), p(a, b, eave), p(-a, b, eave)]
    peaks = [p(-along[0], -along[1], ridge), p(along[0], along[1], ridge)]
    if length > depth:
        faces = [[0, 1, 5], [0, 5, 4], [2, 3, 4], [2, 4, 5], [1, 2, 5], [3, 0, 4], [0, 2, 1], [0, 3, 2]]
    else:
        faces = [[1, 2, 5], [1, 5, 4], [3, 0, 4], [3, 4, 5], [0, 1, 4], [2, 3, 5], [0, 2, 1], [0, 3, 2]]
    mesh.add(np.array(corners + peaks), np.array(faces), 0.25)
