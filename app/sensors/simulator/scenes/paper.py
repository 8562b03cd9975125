"""Twins of the places of the paper's six sequences (Table 1): a garage, an office, and four paths outdoors.

Each path begins with a small lap, so that the first minute already returns to its start; outdoor_4 never returns, as in
the paper.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from app.sensors.simulator.mesh import MeshBuilder
from app.sensors.simulator.raycast import Mover, SimulatedScene
from app.sensors.simulator.scenes import props
from app.sensors.simulator.scenes.plan import level, rectangle, tiled
from app.slam.types import F64

_ASPHALT, _GRASS = 0.18, 0.42
_EDGE = 45.0
"""m of ground around the path; beyond it a laser sees the sky."""

Path = Sequence[tuple[float, float]]


def indoor_1(rng: np.random.Generator) -> SimulatedScene:
    """A parking garage of 44 x 26 m: pillars, beams, rows of cars, two lanes and a cross lane, 232 m a lap."""
    length, depth, height = 44.0, 26.0, 2.6
    mesh = MeshBuilder()
    mesh.surface(np.arange(0, length + 0.01, 1.0), np.arange(0, depth + 0.01, 1.0), level, tiled(0.3, 2.0))
    mesh.quad([(x, y, height) for x, y in rectangle(0, 0, length, depth)], 0.5)
    corners = rectangle(0, 0, length, depth)
    for k in range(4):
        doors = [(s, s + 0.9, 0.0, 2.1) for s in (6.0, 21.0)]
        mesh.wall(corners[k], corners[(k + 1) % 4], height, 0.55, doors)
    for x in np.arange(4.0, length, 6.0):
        for y in (4.6, 9.4, 13.0, 16.6, 21.4):
            if abs(x - 17.0) > 2.2 or y in (4.6, 21.4):
                mesh.box((x, y, height / 2), (0.4, 0.4, height), 0.6)
        mesh.box((x, depth / 2, height - 0.2), (0.35, depth, 0.4), 0.55)
    for y in (3.2, 11.2, 14.9, 22.9):  # pipes and cable trays
        mesh.box((length / 2, y, height - 0.35), (length, rng.uniform(0.1, 0.4), 0.12), rng.uniform(0.3, 0.8))
    for y, yaw in ((2.5, np.pi / 2), (11.1, -np.pi / 2), (14.9, np.pi / 2), (23.5, -np.pi / 2)):
        for x in np.arange(2.4, length - 1.5, 2.7):
            inner = 10.0 < y < 16.0
            if rng.random() < 0.6 and not (inner and (abs(x - 17.0) < 3.4 or x < 8.0 or x > length - 8.0)):
                props.car(mesh, (x, y + rng.normal(scale=0.15), 0.0), yaw + rng.normal(scale=0.03), rng)
    for x, y in ((1.0, 13.0), (43.0, 12.0), (30.0, 13.0)):
        mesh.box((x, y, 0.6), (0.6, 1.0, 1.2), 0.5)
        props.extinguisher(mesh, (x, y + 0.8, 0.0))
    for x in np.arange(3.0, length, 6.0):
        for y in (7.0, 19.0):
            mesh.box((x, y, height - 0.06), (0.15, 1.3, 0.12), 0.9)

    small = [(5.0, 7.0), (17.0, 7.0), (17.0, 19.0), (5.0, 19.0), (5.0, 7.0)]
    rest = [(39.0, 7.0), (39.0, 19.0), (5.0, 19.0), (5.0, 7.0), (17.0, 7.0), (17.0, 19.0), (39.0, 19.0), (39.0, 7.0)]
    someone = props.pedestrian(rectangle(20.0, 6.0, 41.0, 20.2), 1.1)
    return SimulatedScene(mesh.build(), (someone,), np.array([*small, *rest]))


def indoor_2(rng: np.random.Generator) -> SimulatedScene:
    """An open-plan office of 14 x 10 m: islands of desks, chairs at all angles, shelves, sofas, 24 m a lap."""
    length, depth, height = 14.0, 10.0, 2.8
    mesh = MeshBuilder()
    mesh.surface(np.arange(0, length + 0.01, 0.5), np.arange(0, depth + 0.01, 0.5), level, tiled(0.4, 0.5))
    mesh.quad([(x, y, height) for x, y in rectangle(0, 0, length, depth)], 0.75)
    corners = rectangle(0, 0, length, depth)
    windows = [(s, s + 1.5, 0.9, 2.3) for s in np.arange(1.0, length - 2.0, 2.6)]
    for k in range(4):
        mesh.wall(corners[k], corners[(k + 1) % 4], height, 0.65, windows if k == 2 else [(2.0, 2.9, 0.0, 2.1)])
    for start, _, bottom, top in windows:
        mesh.box((length - start - 0.75, depth + 0.05, (bottom + top) / 2), (1.5, 0.02, top - bottom), 0.02)
    islands = [(x, y) for x in (4.4, 6.0, 7.6) for y in (3.9, 5.1)]
    islands += [(x, y) for x in (3.0, 5.4, 7.8) for y in (0.7, 9.2)] + [(12.6, y) for y in (2.0, 4.6, 7.2)]
    for x, y in islands:
        yaw = rng.uniform(-0.04, 0.04) + (np.pi / 2 if x > 12 else 0.0)
        props.table(mesh, (x, y, 0.0), yaw, (1.4, 0.75, 0.74))
        mesh.box((x + rng.uniform(-0.3, 0.3), y, 0.95), (0.5, 0.05, 0.35), 0.1, yaw + rng.uniform(-0.3, 0.3))
        if 3 < y < 6 and x < 12:
            continue
        inward = (-0.75, 0.0) if x > 12 else (0.0, 0.7 if y < 5 else -0.7)
        props.chair(mesh, (x + inward[0], y + inward[1], 0.0), rng.uniform(-np.pi, np.pi))
    for y in (3.2, 6.0):
        props.shelf(mesh, (0.27, y, 0.0), 0.0, rng)
    props.sofa(mesh, (0.6, 8.6, 0.0))
    for x, y in ((0.5, 0.6), (13.4, 0.6), (13.4, 9.4), (10.9, 4.5)):
        props.plant(mesh, (x, y, 0.0), rng)
    mesh.box((11.0, 5.6, height / 2), (0.4, 0.4, height), 0.6)
    for x in np.arange(1.5, length, 3.0):
        for y in (2.5, 7.5):
            mesh.box((x, y, height - 0.03), (1.2, 0.6, 0.06), 0.9)
    path = np.array(rectangle(2.4, 2.3, 9.6, 7.3))
    pacing = props.pedestrian(rectangle(10.4, 1.5, 11.6, 8.5), 0.7)
    return SimulatedScene(mesh.build(), (pacing,), path)


def outdoor_1(rng: np.random.Generator) -> SimulatedScene:
    """Streets of a campus: round a small block, then round the large one, 290 m a lap."""
    return _streets(
        rng,
        [
            *((0.0, 0.0), (15.0, 0.0), (15.0, 11.0), (0.0, 11.0), (0.0, 0.0), (-32.0, 3.0)),
            *((-36.0, 40.0), (-20.0, 62.0), (34.0, 58.0), (42.0, 24.0), (15.0, 0.0)),
        ],
    )


def outdoor_2(rng: np.random.Generator) -> SimulatedScene:
    """Streets of a campus: a figure of eight after a small block, 440 m a lap."""
    return _streets(
        rng,
        [
            *((0.0, 0.0), (16.0, 2.0), (14.0, 13.0), (-1.0, 12.0), (0.0, 0.0), (28.0, -30.0), (64.0, -26.0)),
            *((66.0, 14.0), (34.0, 22.0), (0.0, 0.0), (-30.0, -30.0), (-66.0, -18.0), (-62.0, 22.0), (-28.0, 30.0)),
        ],
    )


def outdoor_3(rng: np.random.Generator) -> SimulatedScene:
    """An open campus with wide lawns, 950 m a lap through three rounds that share streets."""
    return _streets(
        rng,
        [
            *((0.0, 0.0), (15.0, 0.0), (15.0, 10.0), (0.0, 10.0), (0.0, 0.0), (-60.0, -8.0), (-95.0, 30.0)),
            *((-70.0, 80.0), (-10.0, 70.0), (0.0, 10.0), (0.0, 0.0), (50.0, -40.0), (110.0, -30.0), (115.0, 35.0)),
            *((60.0, 62.0), (15.0, 10.0), (15.0, 0.0), (40.0, -70.0), (-20.0, -85.0), (-60.0, -50.0)),
        ],
        built=0.45,
    )


def outdoor_4(rng: np.random.Generator) -> SimulatedScene:
    """One long winding road, 640 m, that never comes back."""
    x = np.arange(0.0, 520.0, 10.0)
    path = np.column_stack([x, 38.0 * np.sin(x / 34.0) + 12.0 * np.sin(x / 71.0)])
    return _streets(rng, [(float(a), float(b)) for a, b in path], closed=False, built=0.5)


def _streets(rng: np.random.Generator, way: Path, *, closed: bool = True, built: float = 0.7) -> SimulatedScene:
    """Rolling ground with buildings (where `built`, 0-1, has them), trees, cars and people along a path."""
    mesh, path = MeshBuilder(), np.array(way)
    phase = rng.uniform(0, 2 * np.pi, 4)

    def height(xy: F64) -> F64:
        x, y = xy.T
        slopes = 1.2 * np.sin(x / 29.0 + phase[0]) + 1.0 * np.cos(y / 24.0 + phase[1])
        return np.asarray(slopes + 0.025 * np.sin(x / 1.3 + phase[2]) * np.sin(y / 1.7 + phase[3]))

    way_points: Any = KDTree(_along(path, closed, 0.2)[0])  # type: ignore[no-untyped-call]  # scipy ships no types

    def off(x: float, y: float) -> float:
        """m to the path, good to 0.1 m."""
        return float(way_points.query([x, y])[0])

    def at(x: float, y: float) -> tuple[float, float, float]:
        return x, y, float(height(np.array([[x, y]]))[0])

    def shade(xy: F64) -> F64:
        return np.where(way_points.query(xy)[0] < 2.0, _ASPHALT, _GRASS)

    low, high = path.min(axis=0) - _EDGE, path.max(axis=0) + _EDGE
    mesh.surface(np.arange(low[0], high[0], 1.0), np.arange(low[1], high[1], 1.0), height, shade)

    places, headings = _along(path, closed, 1.0)
    taken: list[tuple[float, float, float]] = []  # x, y, radius

    def free(x: float, y: float, radius: float) -> bool:
        return all(np.hypot(x - u, y - v) > radius + r for u, v, r in taken)

    for k in range(0, len(places), 9):
        for side in (-1.0, 1.0):
            size = (rng.uniform(9, 18), rng.uniform(7, 11), rng.uniform(4, 12))
            away, wanted = size[1] / 2 + rng.uniform(5.0, 10.0), rng.random() < built
            x, y = _beside(places[k], headings[k], side * away)
            radius = float(np.hypot(size[0], size[1]) / 2)
            clear = all(off(*_turned(x, y, headings[k], u, v)) > 3.2 for u, v in _footprint(size))
            if wanted and clear and free(x, y, radius):
                props.building(mesh, at(x, y), size, headings[k] + rng.normal(scale=0.05))
                taken.append((x, y, radius))
    for k in range(0, len(places), 5):
        side, kind = float(rng.choice([-1.0, 1.0])), rng.random()
        x, y = _beside(places[k], headings[k], side * rng.uniform(2.6, 7.0))
        near_car = _beside(places[k], headings[k], side * 3.6)
        if kind < 0.2 and off(*near_car) > 3.3 and free(*near_car, 2.5):
            props.car(mesh, at(*near_car), headings[k] + rng.normal(scale=0.05), rng)
            taken.append((*near_car, 2.5))
        elif off(x, y) < 2.4 or not free(x, y, 1.0):
            continue
        elif kind < 0.65:
            props.tree(mesh, at(x, y), rng, rng.uniform(4.5, 9.0))
            taken.append((x, y, 1.0))
        elif kind < 0.8:
            props.bush(mesh, at(x, y), rng, rng.uniform(0.6, 1.2))
            taken.append((x, y, 1.0))
        elif kind < 0.9:
            props.lamp_post(mesh, at(x, y))
        else:
            props.bench(mesh, at(x, y), headings[k])
    return SimulatedScene(mesh.build(), _people(rng, places, headings, height), path, closed, height)


def _people(rng: np.random.Generator, places: F64, headings: F64, height: Callable[[F64], F64]) -> tuple[Mover, ...]:
    """Some who walk up and down beside the path."""
    people = []
    for k in rng.choice(len(places) - 20, size=max(2, len(places) // 80), replace=False):
        there = [_beside(places[k + 5 * step], headings[k + 5 * step], 1.6) for step in range(4)]
        back = [_beside(places[k + 5 * step], headings[k + 5 * step], 2.6) for step in reversed(range(4))]
        people.append(props.pedestrian([*there, *back], rng.uniform(0.9, 1.4), rng.uniform(0, 20), height))
    return tuple(people)


def _along(path: F64, closed: bool, step: float) -> tuple[F64, F64]:
    """Places every `step` m of the path and the heading there."""
    line = np.vstack([path, path[:1]]) if closed else path
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    s = np.arange(0.0, arc[-1], step)
    places = np.column_stack([np.interp(s, arc, line[:, k]) for k in (0, 1)])
    ahead = np.column_stack([np.interp(np.minimum(s + 0.5, arc[-1]), arc, line[:, k]) for k in (0, 1)]) - places
    return places, np.arctan2(ahead[:, 1], ahead[:, 0])


def _beside(place: F64, heading: float, left: float) -> tuple[float, float]:
    return float(place[0] - left * np.sin(heading)), float(place[1] + left * np.cos(heading))


def _turned(x: float, y: float, heading: float, u: float, v: float) -> tuple[float, float]:
    c, s = float(np.cos(heading)), float(np.sin(heading))
    return x + c * u - s * v, y + s * u + c * v


def _footprint(size: tuple[float, float, float]) -> list[tuple[float, float]]:
    """Points of a building's outline in its own axes, its corners and edges."""
    a, b = size[0] / 2, size[1] / 2
    return [(u * a, v * b) for u in (-1.0, -0.5, 0.0, 0.5, 1.0) for v in (-1.0, 0.0, 1.0)]
