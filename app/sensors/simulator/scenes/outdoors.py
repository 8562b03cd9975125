"""Outdoor scenes: a campus, and twins of the paper's four outdoor paths (Table 1).

The twins begin with a small lap, so that the first minute already returns to its start; outdoor_4 never returns, as in
the paper.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from app.sensors.simulator.mesh import MeshBuilder
from app.sensors.simulator.raycast import Mover, SimulatedScene
from app.sensors.simulator.scenes import props
from app.sensors.simulator.scenes.props import Corners, Point, on_ground
from app.sensors.simulator.trajectory import places_at
from app.slam.metrics import walked_m
from app.slam.types import F64

_ASPHALT, _GRASS = 0.18, 0.42
_EDGE = 45.0
"""m, width of the ground around the path; beyond it, beams hit nothing."""

_CAMPUS = [
    *((-14.0, -13.0), (0.0, -15.0), (14.0, -12.0), (22.0, -3.0), (19.0, 8.0)),
    *((8.0, 13.0), (-7.0, 11.0), (-20.0, 12.0), (-25.0, 2.0), (-22.0, -8.0)),
]
_TWO_BLOCKS = [
    *((0.0, 0.0), (15.0, 0.0), (15.0, 11.0), (0.0, 11.0), (0.0, 0.0), (-32.0, 3.0)),
    *((-36.0, 40.0), (-20.0, 62.0), (34.0, 58.0), (42.0, 24.0), (15.0, 0.0)),
]
_FIGURE_OF_EIGHT = [
    *((0.0, 0.0), (16.0, 2.0), (14.0, 13.0), (-1.0, 12.0), (0.0, 0.0), (28.0, -30.0), (64.0, -26.0)),
    *((66.0, 14.0), (34.0, 22.0), (0.0, 0.0), (-30.0, -30.0), (-66.0, -18.0), (-62.0, 22.0), (-28.0, 30.0)),
]
_THREE_ROUNDS = [
    *((0.0, 0.0), (15.0, 0.0), (15.0, 10.0), (0.0, 10.0), (0.0, 0.0), (-60.0, -8.0), (-95.0, 30.0)),
    *((-70.0, 80.0), (-10.0, 70.0), (0.0, 10.0), (0.0, 0.0), (50.0, -40.0), (110.0, -30.0), (115.0, 35.0)),
    *((60.0, 62.0), (15.0, 10.0), (15.0, 0.0), (40.0, -70.0), (-20.0, -85.0), (-60.0, -50.0)),
]


def outdoor(rng: np.random.Generator) -> SimulatedScene:
    """A campus with slopes, buildings, trees, hedges, parked cars and pedestrians."""
    mesh = MeshBuilder()
    path = np.array(_CAMPUS)
    phase = rng.uniform(0, 2 * np.pi, 4)

    def height(xy: F64) -> F64:
        x, y = xy.T
        slopes = 1.3 * np.sin(x / 17.0 + phase[0]) + 1.0 * np.cos(y / 13.0 + phase[1]) + 0.015 * x
        bumps = 0.03 * np.sin(x / 1.3 + phase[2]) * np.sin(y / 1.7 + phase[3])
        return np.asarray(slopes + bumps)

    def shade(xy: F64) -> F64:
        return np.where(_distance_to_path(xy, path) < 1.6, _ASPHALT, _GRASS)

    at = on_ground(height)
    mesh.surface(np.arange(-60.0, 60.01, 0.75), np.arange(-50.0, 50.01, 0.75), height, shade)

    for x, y, size, yaw in (
        (-4.0, 27.0, (26.0, 10.0, 9.0), 0.05),
        (38.0, 10.0, (12.0, 24.0, 12.0), -0.1),
        (-40.0, 6.0, (10.0, 22.0, 7.0), 0.08),
        (12.0, -32.0, (30.0, 10.0, 8.0), -0.04),
        (-28.0, -28.0, (14.0, 11.0, 6.0), 0.5),
        (-1.0, -1.0, (9.0, 7.0, 4.5), 0.2),
    ):
        props.building(mesh, at(x, y), size, yaw)
    for k in range(7):
        props.car(mesh, at(-12.0 + 2.9 * k, -20.5 + 0.1 * k), np.pi / 2 + rng.normal(scale=0.04), rng)
    for x, y in ((27.0, -14.0), (28.5, 3.0)):
        props.car(mesh, at(x, y), rng.uniform(0, np.pi), rng)

    planted = 0
    while planted < 26:
        x, y = rng.uniform((-34, -26), (32, 21))
        off = float(_distance_to_path(np.array([[x, y]]), path)[0])
        if off < 2.2 or (abs(x + 1) < 7 and abs(y + 1) < 6) or (y < -17 and abs(x + 3) < 13):
            continue
        if rng.random() < 0.7:
            props.tree(mesh, at(x, y), rng, rng.uniform(4.5, 9.0))
        else:
            props.bush(mesh, at(x, y), rng, rng.uniform(0.6, 1.2))
        planted += 1
    for start, end in (((-16.0, 15.5), (2.0, 16.5)), ((24.5, 6.0), (20.0, 14.0))):
        props.hedge(mesh, at(*start), at(*end), rng)
    for k in (0, 2, 4, 6, 8):
        middle = (path[k] + path[(k + 1) % len(path)]) / 2
        outward = middle / np.linalg.norm(middle)
        props.lamp_post(mesh, at(*(middle + 2.3 * outward)))
        props.bench(mesh, at(*(middle - 2.4 * outward)), float(np.arctan2(outward[1], outward[0])))

    people = (
        props.pedestrian(path * 1.04 + [0.0, 0.4], 1.1, 40.0, height),
        props.pedestrian(path[::-1] * 0.94, 1.3, 25.0, height, 1.65),
        props.pedestrian([(-8.0, 17.5), (8.0, 18.0), (9.0, 19.5), (-8.0, 19.0)], 1.2, 0.0, height, 1.8),
    )
    return SimulatedScene(mesh.build(), people, path, height=height)


def outdoor_1(rng: np.random.Generator) -> SimulatedScene:
    """Streets of a campus: round a small block, then round the large one, 290 m a lap."""
    return _streets(rng, _TWO_BLOCKS)


def outdoor_2(rng: np.random.Generator) -> SimulatedScene:
    """Streets of a campus: a figure of eight after a small block, 440 m a lap."""
    return _streets(rng, _FIGURE_OF_EIGHT)


def outdoor_3(rng: np.random.Generator) -> SimulatedScene:
    """An open campus with wide lawns, 950 m a lap through three rounds that share streets."""
    return _streets(rng, _THREE_ROUNDS, built=0.45)


def outdoor_4(rng: np.random.Generator) -> SimulatedScene:
    """One long winding road, 640 m, that never returns."""
    x = np.arange(0.0, 520.0, 10.0)
    path = np.column_stack([x, 38.0 * np.sin(x / 34.0) + 12.0 * np.sin(x / 71.0)])
    return _streets(rng, path, closed=False, built=0.5)


def _streets(rng: np.random.Generator, way: Corners, *, closed: bool = True, built: float = 0.7) -> SimulatedScene:
    """Rolling ground with buildings (density `built`, 0-1), trees, cars and people along a path."""
    mesh, path = MeshBuilder(), np.array(way)
    phase = rng.uniform(0, 2 * np.pi, 4)

    def height(xy: F64) -> F64:
        x, y = xy.T
        slopes = 1.2 * np.sin(x / 29.0 + phase[0]) + 1.0 * np.cos(y / 24.0 + phase[1])
        return np.asarray(slopes + 0.025 * np.sin(x / 1.3 + phase[2]) * np.sin(y / 1.7 + phase[3]))

    way_points: Any = KDTree(_along(path, closed, 0.2)[0])  # type: ignore[no-untyped-call]  # scipy ships no types

    def off(*places: tuple[float, float]) -> float:
        """Least distance (m) of these points from the path, accurate to 0.1 m."""
        return float(way_points.query(places)[0].min())

    def shade(xy: F64) -> F64:
        return np.where(way_points.query(xy)[0] < 2.0, _ASPHALT, _GRASS)

    at = on_ground(height)
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
            clear = off(*_footprint(x, y, headings[k], size)) > 3.2
            if wanted and clear and free(x, y, radius):
                props.building(mesh, at(x, y), size, headings[k] + rng.normal(scale=0.05))
                taken.append((x, y, radius))
    for k in range(0, len(places), 5):
        side, kind = float(rng.choice([-1.0, 1.0])), rng.random()
        x, y = _beside(places[k], headings[k], side * rng.uniform(2.6, 7.0))
        near_car = _beside(places[k], headings[k], side * 3.6)
        if kind < 0.2 and off(near_car) > 3.3 and free(*near_car, 2.5):
            props.car(mesh, at(*near_car), headings[k] + rng.normal(scale=0.05), rng)
            taken.append((*near_car, 2.5))
        elif off((x, y)) < 2.4 or not free(x, y, 1.0):
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
    """People who walk up and down beside the path."""
    people = []
    for k in rng.choice(len(places) - 20, size=max(2, len(places) // 80), replace=False):
        there = [_beside(places[k + 5 * step], headings[k + 5 * step], 1.6) for step in range(4)]
        back = [_beside(places[k + 5 * step], headings[k + 5 * step], 2.6) for step in reversed(range(4))]
        people.append(props.pedestrian([*there, *back], rng.uniform(0.9, 1.4), rng.uniform(0, 20), height))
    return tuple(people)


def _along(path: F64, closed: bool, step: float) -> tuple[F64, F64]:
    """Places every `step` m along the path, and the headings there."""
    line = np.vstack([path, path[:1]]) if closed else path
    arc = walked_m(line)
    s = np.arange(0.0, arc[-1], step)
    places = places_at(s, arc, line)
    ahead = places_at(np.minimum(s + 0.5, arc[-1]), arc, line) - places
    return places, np.arctan2(ahead[:, 1], ahead[:, 0])


def _beside(place: F64, heading: float, left: float) -> tuple[float, float]:
    return float(place[0] - left * np.sin(heading)), float(place[1] + left * np.cos(heading))


def _footprint(x: float, y: float, heading: float, size: tuple[float, float, float]) -> list[Point]:
    """Points on a building's outline: its corners, and some points on its edges."""
    c, s = float(np.cos(heading)), float(np.sin(heading))
    outline = [(u * size[0] / 2, v * size[1] / 2) for u in (-1.0, -0.5, 0.0, 0.5, 1.0) for v in (-1.0, 0.0, 1.0)]
    return [(x + c * u - s * v, y + s * u + c * v) for u, v in outline]


def _distance_to_path(xy: F64, path: F64) -> F64:
    """(n,) distances (m) of (n, 2) points from a closed polyline of (m, 2) waypoints."""
    nearest = np.full(len(xy), np.inf)
    for a, b in zip(path, np.roll(path, -1, axis=0), strict=True):
        share = np.clip((xy - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
        nearest = np.minimum(nearest, np.linalg.norm(xy - a - share[:, None] * (b - a), axis=1))
    return nearest
