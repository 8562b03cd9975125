"""A museum's court and its glass-roofed hall: a path outdoors, in through one door and out through the other."""

import numpy as np

from app.sensors.simulator.mesh import MeshBuilder
from app.sensors.simulator.raycast import SimulatedScene
from app.sensors.simulator.scenes import props
from app.sensors.simulator.scenes.props import level, on_ground, tiled
from app.slam.types import F64

HALL = (-9.0, 9.0, 6.0, 15.0)
"""x from, to, y from, to of the hall's floor, m."""

DOORS = (-5.4, 5.4)
EAVES = 5.2


def museum(rng: np.random.Generator) -> SimulatedScene:
    """Outdoors and indoors: round a sloping court with trees, cars and a fountain, and through a hall with pillars."""
    mesh = MeshBuilder()
    _court(mesh, rng)
    _hall(mesh, rng)
    path = np.array(
        [(0.0, -8.6), (4.2, -7.2), (5.4, -3.0), (5.4, 10.4), (-5.4, 10.4), (-5.4, -3.0), (-4.2, -7.2)], np.float64
    )
    people = (
        props.pedestrian([(-8.0, 0.5), (8.0, 1.5), (9.5, 3.0), (-8.0, 2.0)], 1.1, 7.0, _terrain),
        props.pedestrian([(-3.0, 12.9), (3.0, 12.9), (3.6, 13.5), (-3.0, 13.6)], 0.7, 1.0, None, 1.65),
        props.pedestrian([(-16.0, -15.6), (16.0, -15.4), (16.0, -16.6), (-16.0, -16.8)], 1.3, 20.0, _terrain),
    )
    return SimulatedScene(mesh.build(), people, path, height=_terrain)


def _terrain(xy: F64) -> F64:
    """Height of the terrain: level at the hall, then falling towards the street, with a knoll in the east."""
    x, y = xy.T
    down = np.maximum(2.0 - y, 0.0)
    slope = 0.075 * down**2 / (down + 4.0)
    knoll = 1.2 * np.exp(-(((x - 15.0) / 5.0) ** 2) - ((y + 3.0) / 6.0) ** 2)
    return np.where(y > 5.0, 0.0, knoll - slope)


def _court(mesh: MeshBuilder, rng: np.random.Generator) -> None:
    def shade(xy: F64) -> F64:
        x, y = xy.T
        paved = (np.abs(np.abs(x) - 5.4) < 1.5) & (y > -6) | (np.hypot(x, y + 4.0) < 4.0) | (y > 2.5) & (np.abs(x) < 9)
        street = y < -17.0
        return np.where(street, 0.16, np.where(paved | (np.abs(y + 8.0) < 1.5), tiled(0.3, 0.5)(xy), 0.45))

    at = on_ground(_terrain)
    mesh.surface(np.arange(-40.0, 40.01, 0.5), np.arange(-35.0, HALL[2] + 0.01, 0.5), _terrain, shade)

    mesh.cylinder(at(0.0, -4.0), 1.7, 0.45, 0.5, sides=24)  # the fountain
    mesh.cylinder(at(0.0, -4.0), 0.25, 1.3, 0.5)
    mesh.cylinder((0.0, -4.0, at(0.0, -4.0)[2] + 1.3), 0.3, 0.25, 0.5, top_radius=0.9, sides=24)
    for k in range(6):
        angle = np.pi / 6 + k * np.pi / 3
        props.bush(mesh, at(2.6 * np.cos(angle), -4.0 + 2.6 * np.sin(angle)), rng, 0.5)
    for x, y in ((-8.2, -4.5), (-8.4, -9.5), (8.2, -5.0), (8.6, -10.5), (-12.5, -1.0), (-13.0, -8.0), (13.0, -8.5)):
        props.tree(mesh, at(x, y), rng, rng.uniform(4.5, 7.0))
    for x in (-14.0, -5.0, 4.5, 13.5):
        props.tree(mesh, at(x, -13.6), rng, rng.uniform(5.0, 7.5))
    for x in (-8.0, 0.0, 8.0):
        props.lamp_post(mesh, at(x, -10.6), 4.0)
    for x in (-2.4, 2.4):
        props.bench(mesh, at(x, 0.6), -np.pi / 2)
        props.bench(mesh, at(x, -10.2), np.pi / 2)
    props.hedge(mesh, at(-16.5, -11.8), at(-2.0, -11.8), rng, 0.8)
    props.hedge(mesh, at(2.5, -11.8), at(16.5, -11.8), rng, 0.8)
    for x in (-13.5, -8.3, -2.9, 3.5, 8.8):
        props.car(mesh, at(x + rng.uniform(-0.3, 0.3), -18.4), rng.normal(scale=0.03), rng)
    props.building(mesh, at(-24.0, -3.0), (9.0, 17.0, 7.5), 0.0)
    props.building(mesh, at(2.0, -30.0), (34.0, 9.0, 10.0), 0.02)
    props.building(mesh, at(28.0, -4.0), (10.0, 16.0, 6.0), 0.1)


def _hall(mesh: MeshBuilder, rng: np.random.Generator) -> None:
    x0, x1, y0, y1 = HALL
    mesh.surface(np.arange(x0, x1 + 0.01, 0.6), np.arange(y0, y1 + 0.01, 0.6), level, tiled(0.5))
    doors = [(x - x0 - 1.1, x - x0 + 1.1, 0.0, 2.6) for x in DOORS]
    windows = [(x - x0 - 0.7, x - x0 + 0.7, 1.0, 3.6) for x in (-8.0, -2.0, 0.0, 2.0, 8.0)]
    mesh.wall((x0, y0), (x1, y0), EAVES, 0.45, doors + windows, thickness=0.35)
    mesh.wall((x1, y0), (x1, y1), EAVES, 0.5, [(2.0, 7.0, 3.4, 4.6)], thickness=0.35)
    mesh.wall((x1, y1), (x0, y1), EAVES, 0.5, thickness=0.35)
    mesh.wall((x0, y1), (x0, y0), EAVES, 0.5, [(2.0, 7.0, 3.4, 4.6)], thickness=0.35)
    for s0, s1, bottom, top in windows:
        x = x0 + (s0 + s1) / 2
        mesh.box((x, y0, (bottom + top) / 2), (s1 - s0, 0.02, top - bottom), 0.01)
        mesh.box((x, y0, (bottom + top) / 2), (0.06, 0.08, top - bottom), 0.6)
        mesh.box((x, y0 - 0.22, bottom - 0.05), (s1 - s0 + 0.3, 0.2, 0.1), 0.6)
    for x in DOORS:
        mesh.box((x, y0 - 0.9, 2.9), (3.2, 1.8, 0.12), 0.5)
        for side in (-1, 1):
            props.door_leaf(mesh, (x + side * 1.1, y0 - 0.2, 0.0), -np.pi / 2 + side * 0.3, 1.05, 2.5)

    for x in np.arange(x0 + 1.5, x1, 3.0):  # trusses carry the glass
        mesh.box((x, (y0 + y1) / 2, EAVES - 0.2), (0.16, y1 - y0, 0.3), 0.5)
        mesh.box((x, (y0 + y1) / 2 - 2.3, EAVES + 0.55), (0.1, 4.9, 0.12), 0.5, tilt=0.3)
        mesh.box((x, (y0 + y1) / 2 + 2.3, EAVES + 0.55), (0.1, 4.9, 0.12), 0.5, tilt=-0.3)
    for y in (y0 + 2.6, y1 - 2.6):
        mesh.box(((x0 + x1) / 2, y, EAVES - 0.45), (x1 - x0, 0.2, 0.25), 0.5)
        for x in (-8.0, -2.6, 0.0, 2.6, 8.0):
            mesh.cylinder((x, y, 0.0), 0.26, EAVES - 0.5, 0.65, sides=18)
            mesh.box((x, y, 0.12), (0.75, 0.75, 0.24), 0.6)
            mesh.box((x, y, EAVES - 0.65), (0.7, 0.7, 0.2), 0.6)

    for x in np.arange(x0 + 1.8, x1 - 1.0, 2.4):  # paintings
        size = rng.uniform(0.7, 1.6), rng.uniform(0.8, 1.4)
        mesh.box((x, y1 - 0.2, 1.7), (size[0] + 0.16, 0.05, size[1] + 0.16), 0.3)
        mesh.box((x, y1 - 0.23, 1.7), (size[0], 0.05, size[1]), rng.uniform(0.15, 0.9))
    for x, y in ((-1.3, 8.5), (1.3, 12.4), (-7.3, 13.6), (7.3, 13.6)):
        props.sculpture(mesh, (x, y, 0.0), rng)
    for x, y in ((1.3, 8.4), (-1.3, 12.3), (7.4, 9.6)):  # show cases
        mesh.box((x, y, 0.4), (1.1, 0.7, 0.8), 0.3)
        mesh.ellipsoid((x, y, 0.95), (0.2, 0.14, 0.15), 0.7)
    mesh.box((-7.9, 10.4, 0.55), (0.7, 2.4, 1.1), 0.5)  # the desk
    props.shelf(mesh, (8.6, 11.5, 0.0), np.pi, rng, (2.0, 2.2))
    for x, y in ((-8.4, 6.8), (8.4, 6.8), (-3.4, 6.7), (3.4, 6.7)):
        props.plant(mesh, (x, y, 0.0), rng)
    for x in (-4.4, 4.4):
        props.bench(mesh, (x, 13.9, 0.0), -np.pi / 2)
