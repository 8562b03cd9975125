"""A cloister on a slope: a court with columns and a garden, a raised hall, a black passage, and a park below."""

import numpy as np

from app.sensors.simulator.mesh import MeshBuilder
from app.sensors.simulator.raycast import SimulatedScene
from app.sensors.simulator.scenes import props
from app.sensors.simulator.scenes.props import grid, level, on_ground, tiled
from app.slam.types import F64

GARTH, COURT = 6.0, 9.0
"""m, from the court's middle to its columns, and to its walls."""
HALL = (9.0, 17.6)
"""y of the hall's near and far walls; the hall is as wide as the court."""
FLOOR, HEIGHT = 0.64, 5.6
"""m, height of the hall's floor above the court, and of its ceiling above its floor."""
DOORS = (-5.4, 5.4)
"""x of the hall's doors, each at the top of four steps."""
_STEPS, _TREAD = 4, 0.3
PASSAGE = (9.1, 11.3, -11.6, 1.2)
"""x from, to, y from, to of the black passage along the court's east wall."""
_STONE, _PLASTER, _FELT, _GRASS = 0.55, 0.62, 0.001, 0.42

_FIRST_LAP = [
    *((-0.6, -5.0), (1.5, -2.6), (2.9, -0.6), (5.0, 0.0), (8.4, 0.0), (10.2, -0.2)),
    *((10.2, -10.4), (8.4, -11.0), (3.6, -12.6), (0.6, -11.8), (0.0, -9.6), (0.0, -7.0)),
]
"""Path round the fountain, through the passage and the park, and back through the gate."""
_SECOND_LAP = [
    *((-0.6, -5.0), (-1.6, -2.6), (-2.9, -0.4), (-5.0, 0.0), (-7.0, 0.2), (-7.5, 6.6), (-5.4, 7.7), (-5.4, 11.0)),
    *((-3.8, 13.6), (3.8, 13.6), (5.4, 11.0), (5.4, 7.7), (7.5, 6.6), (7.4, 0.8), (5.0, 0.0), (2.6, -1.4)),
    *((1.0, -3.4), (-0.3, -5.0), (0.0, -8.0)),
]
"""Path up one flight of steps, through the hall, and down the other."""


def cloister(rng: np.random.Generator) -> SimulatedScene:
    """A figure of eight through a cloister: a black passage and a sloping park, then a raised hall with pillars."""
    mesh = MeshBuilder()
    _court(mesh, rng)
    _passage(mesh)
    _hall(mesh, rng)
    _tower(mesh)
    _park(mesh, rng)
    people = (
        props.pedestrian([(3.6, 5.0), (-4.0, 4.6), (-4.4, 1.4), (-7.6, -1.0), (-7.4, -7.4), (-3.0, -7.6)], 1.0, 0.0),
        props.pedestrian([(-2.2, 16.6), (2.2, 16.6), (2.4, 15.2), (-2.4, 15.2)], 0.6, 1.0, _floor, 1.65),
        props.pedestrian([(-4.0, -13.5), (-9.0, -12.5), (-9.0, -15.0), (2.0, -16.0)], 1.2, 4.0, _floor, 1.8),
    )
    path = np.array([*_FIRST_LAP, *_SECOND_LAP], np.float64)
    return SimulatedScene(mesh.build(), people, path, closed=False, height=_floor)


def _terrain(xy: F64) -> F64:
    """Height of the terrain: level at the court's wall, then falling, with a knoll in the west."""
    x, y = xy.T
    down = np.maximum(-COURT - y, 0.0)
    knoll = 1.3 * np.exp(-(((x + 9.0) / 3.5) ** 2) - ((y + 15.0) / 3.0) ** 2)
    return np.where(y > -COURT, 0.0, knoll * np.minimum(down / 3.0, 1.0) - 0.12 * down**2 / (down + 2.0))


def _ramp(xy: F64) -> F64:
    """Height of the passage's floor, which falls from the court to the park."""
    low = float(_terrain(np.array([[PASSAGE[0], PASSAGE[2]]]))[0])
    return np.asarray(low * np.clip((-1.0 - xy[:, 1]) / (-1.0 - PASSAGE[2]), 0.0, 1.0))


def _floor(xy: F64) -> F64:
    """Height of the floor on which people walk, including the treads of the steps."""
    x, y = xy.T
    step = np.clip(np.ceil((y - HALL[0]) / _TREAD + _STEPS), 0, _STEPS) * FLOOR / _STEPS
    below = np.where(x > PASSAGE[0], _ramp(xy), _terrain(xy))
    return np.where(y > HALL[0] - _STEPS * _TREAD, step, below)


def _court(mesh: MeshBuilder, rng: np.random.Generator) -> None:
    def shade(xy: F64) -> F64:
        x, y = np.abs(xy).T
        beds = (np.maximum(x, y) < GARTH - 0.5) & (np.minimum(x, y) > 1.0) & (np.hypot(x, y) > 3.6)
        return np.where(beds, _GRASS, tiled(0.3, 0.6)(xy))

    ticks = np.arange(-COURT, COURT + 0.01, 0.3)
    mesh.surface(ticks, ticks, level, shade)
    windows = [(s, s + 1.4, 1.1, 2.7) for s in (2.3, 14.3)]
    corners = [(-COURT, -COURT), (COURT, -COURT), (COURT, COURT), (-COURT, COURT)]
    mesh.wall(corners[0], corners[1], 3.7, _PLASTER, [(COURT - 1.3, COURT + 1.3, 0.0, 2.8), *windows], 0.4)
    mesh.wall(corners[3], corners[0], 3.7, _PLASTER, [(s, s + 1.4, 1.1, 2.7) for s in (6.3, 10.3, 14.3)], 0.4)
    mesh.wall(corners[1], corners[2], 3.7, _PLASTER, [(COURT - 1.0, COURT + 0.8, 0.0, 2.5)], 0.2)
    for x in (-1.7, 1.7):  # the gate's pillars, with balls on them
        mesh.box((x, -COURT, 1.8), (0.7, 0.7, 3.6), _STONE)
        mesh.ellipsoid((x, -COURT, 3.9), (0.3, 0.3, 0.3), _STONE)
    places = np.linspace(-GARTH, GARTH, 6)
    for x, y, _ in grid(places, places, 0.0):
        if max(abs(x), abs(y)) == GARTH:
            mesh.cylinder((x, y, 0.0), 0.19, 3.0, _STONE, sides=16)
            mesh.box((x, y, 0.14), (0.6, 0.6, 0.28), _STONE)
            mesh.box((x, y, 2.92), (0.56, 0.56, 0.2), _STONE)
    for side in (-1, 1):  # beams on the columns: of stone, and of wood to the walls
        mesh.box((0.0, side * GARTH, 3.2), (2 * GARTH + 0.6, 0.5, 0.4), _STONE)
        mesh.box((side * GARTH, 0.0, 3.2), (0.5, 2 * GARTH + 0.6, 0.4), _STONE)
        for s in np.linspace(-GARTH - 2.0, GARTH + 2.0, 9):
            mesh.box((s, side * (GARTH + COURT) / 2, 3.5), (0.14, COURT - GARTH + 0.4, 0.2), 0.35)
            mesh.box((side * (GARTH + COURT) / 2, s, 3.5), (COURT - GARTH + 0.4, 0.14, 0.2), 0.35)

    mesh.cylinder((0.0, 0.0, 0.0), 1.5, 0.5, _STONE, sides=24)  # the fountain
    mesh.cylinder((0.0, 0.0, 0.5), 0.2, 1.0, _STONE)
    mesh.cylinder((0.0, 0.0, 1.45), 0.2, 0.25, _STONE, top_radius=0.8, sides=24)
    for x, y, _ in grid((-4.1, 4.1), (-4.1, 4.1), 0.0):
        props.tree(mesh, (x, y, 0.0), rng, rng.uniform(4.6, 6.2))
        for dx, dy in ((-1.1, 0.9), (0.9, -1.1), (1.0, 0.9)):
            props.bush(mesh, (x + dx, y + dy, 0.0), rng, rng.uniform(0.35, 0.55))
    for x, y, yaw in ((8.3, -3.0, np.pi), (-8.3, -3.0, 0.0), (-8.3, 3.4, 0.0), (3.6, -8.3, np.pi / 2)):
        props.bench(mesh, (x, y, 0.0), yaw)
    for x, y, _ in grid((-8.4, 8.4), (-8.4, 8.2), 0.0):
        props.plant(mesh, (x, y, 0.0), rng)


def _passage(mesh: MeshBuilder) -> None:
    """Walls, floor and ceiling of black felt: few returns, and nothing that shows the distance travelled."""
    x0, x1, y0, y1 = PASSAGE
    middle, length = (y0 + y1) / 2, y1 - y0
    mesh.surface(np.array([COURT, x1]), np.linspace(y0, y1, 30), _ramp, lambda xy: np.full(len(xy), _FELT))
    mesh.box((x1, middle, 0.6), (0.2, length, 4.8), _FELT)
    mesh.wall((x0 + 0.05, -1.05), (x0 + 0.05, y0 + 1.7), 5.0, _FELT, thickness=0.1, base=-1.6)
    for y in (y0, y1):
        mesh.box(((x0 + x1) / 2, y, 0.6), (x1 - x0, 0.2, 4.8), _FELT)
    mesh.box(((x0 + x1) / 2, middle, 2.9), (x1 - x0 + 0.2, length + 0.2, 0.1), _FELT)


def _hall(mesh: MeshBuilder, rng: np.random.Generator) -> None:
    near, far = HALL
    mesh.surface(
        np.arange(-COURT, COURT + 0.01, 0.6), np.linspace(near, far, 17), lambda xy: level(xy) + FLOOR, tiled(0.45)
    )
    mesh.quad([(x, y, FLOOR + HEIGHT) for x, y in ((-COURT, near), (COURT, near), (COURT, far), (-COURT, far))], 0.7)
    doors = [(x + COURT - 1.0, x + COURT + 1.0, FLOOR - 0.01, FLOOR + 2.9) for x in DOORS]
    windows = [(x + COURT - 0.6, x + COURT + 0.6, 2.0, 4.6) for x in (-2.2, 0.0, 2.2)]
    mesh.wall((-COURT, near), (COURT, near), FLOOR + HEIGHT, 0.5, [*doors, *windows], 0.4)
    for start, end in (((COURT, near), (COURT, far)), ((COURT, far), (-COURT, far)), ((-COURT, far), (-COURT, near))):
        mesh.wall(start, end, FLOOR + HEIGHT, _PLASTER, thickness=0.3)
    gable = np.array([(-COURT, near, FLOOR + HEIGHT), (COURT, near, FLOOR + HEIGHT), (0.0, near, FLOOR + HEIGHT + 3.6)])
    mesh.add(gable, np.array([[0, 1, 2]]), 0.5)
    for x in DOORS:
        for k in range(_STEPS):
            front, top = near - (_STEPS - k) * _TREAD, (k + 1) * FLOOR / _STEPS
            mesh.box((x, (front + near) / 2, top / 2), (2.6, near - front, top - 0.002), _STONE)
            tread = [(x - 1.3, front), (x + 1.3, front), (x + 1.3, front + _TREAD), (x - 1.3, front + _TREAD)]
            mesh.quad([(*corner, top) for corner in tread], _STONE, ground=True)
        mesh.quad([(x + u, near + v, FLOOR) for u, v in ((-1, -0.2), (1, -0.2), (1, 0.2), (-1, 0.2))], _STONE, True)
    for x, y, _ in grid((-7.4, -2.5, 2.5, 7.4), (11.4, 15.4), 0.0):
        mesh.cylinder((x, y, FLOOR), 0.3, HEIGHT, 0.65, sides=18)
        mesh.box((x, y, FLOOR + 0.15), (0.9, 0.9, 0.3), _STONE)
        mesh.box((x, y, FLOOR + HEIGHT - 0.2), (0.9, 0.9, 0.4), _STONE)
    for y in (11.4, 15.4):
        mesh.box((0.0, y, FLOOR + HEIGHT - 0.2), (2 * COURT, 0.4, 0.4), _STONE)
    for x in np.arange(-COURT + 1.5, COURT - 1.0, 2.4):  # paintings
        size = rng.uniform(0.8, 1.7), rng.uniform(0.9, 1.5)
        mesh.box((x, far - 0.2, FLOOR + 1.8), (size[0] + 0.2, 0.06, size[1] + 0.2), 0.3)
        mesh.box((x, far - 0.24, FLOOR + 1.8), (size[0], 0.06, size[1]), rng.uniform(0.15, 0.9))
    for x, y in ((0.0, 11.4), (-6.8, 13.6), (6.8, 13.6), (0.0, 15.8)):
        props.sculpture(mesh, (x, y, FLOOR), rng)
    for x in (-2.2, 2.2):
        props.bench(mesh, (x, 17.0, FLOOR), -np.pi / 2)


def _tower(mesh: MeshBuilder) -> None:
    """A bell tower behind the court's west wall."""
    at, wide = np.array([-11.2, 6.4]), 3.4
    mesh.box((*at, 3.0), (wide, wide, 6.0), 0.5)
    for z in (3.6, 6.0, 8.2):
        mesh.box((*at, z), (wide + 0.4, wide + 0.4, 0.24), 0.65)
    for x, y, _ in grid((-1.4, 1.4), (-1.4, 1.4), 0.0):
        mesh.box((at[0] + x, at[1] + y, 7.1), (0.6, 0.6, 2.2), 0.5)
    mesh.cylinder((*at, 8.3), 2.6, 2.2, 0.3, top_radius=0.05, sides=4)
    mesh.ellipsoid((*at, 7.1), (0.5, 0.5, 0.6), 0.8)


def _park(mesh: MeshBuilder, rng: np.random.Generator) -> None:
    def shade(xy: F64) -> F64:
        x, y = xy.T
        walk = (np.abs(x) < 1.2) & (y > -13.0) | (np.abs(y + 12.2) < 1.2) & (x > 0.0)
        return np.where(walk, tiled(0.3, 0.5)(xy), _GRASS)

    at = on_ground(_terrain)
    mesh.surface(np.arange(-20.0, 20.01, 0.5), np.arange(-24.0, -COURT + 0.01, 0.5), _terrain, shade)
    for x, y in ((7.4, -15.0), (1.6, -16.2), (-5.4, -12.6), (-11.5, -10.5), (13.0, -13.0)):
        props.tree(mesh, at(x, y), rng, rng.uniform(4.4, 6.2))
    for x, y in ((-2.6, -11.2), (2.6, -10.4), (-4.4, -10.2), (5.6, -10.4)):
        props.bush(mesh, at(x, y), rng, rng.uniform(0.5, 0.8))
    for x in (3.6, 5.6):
        props.bench(mesh, at(x, -14.6), np.pi / 2)
