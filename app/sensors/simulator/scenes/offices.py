"""Storeys of an office building: a loop of corridors, two wings with a lobby, and two loops joined by a staircase."""

from itertools import pairwise

import numpy as np

from app.sensors.simulator.mesh import MeshBuilder, Triple, line_through
from app.sensors.simulator.raycast import SimulatedScene
from app.sensors.simulator.scenes import props
from app.sensors.simulator.scenes.props import Point, grid, rectangle, sides, storey, tiled
from app.slam.types import F64

HEIGHT = 2.7
WIDTH = 2.4
"""m, width and height of the corridors."""
LENGTH, DEPTH, LOBBY = 42.0, 15.0, 6.0
"""m, of `building`."""
STOREY, STEPS, RUN = 3.3, 10, 0.32
"""m, from floor to floor of `storeys`; number of steps in each of the two flights, and m from step to step."""


def corridor(rng: np.random.Generator) -> SimulatedScene:
    """A 24 x 14 m loop of office corridors: doors, open rooms, pillars, ceiling lamps, a person walking."""
    length, depth = 24.0, 14.0
    mesh = MeshBuilder()
    reach = 4.2  # rooms behind the outer walls
    storey(mesh, rectangle(-reach, -reach, length + reach, depth + reach), HEIGHT, 0.6, tiled(0.38), 0.7)
    outer = rectangle(0, 0, length, depth)
    inner = rectangle(WIDTH, WIDTH, length - WIDTH, depth - WIDTH)
    for outside, inside in zip(sides(outer), sides(inner), strict=True):
        _outer_wall(mesh, *outside, rng)
        _inner_wall(mesh, *inside, rng)

    middle = WIDTH / 2
    mesh.boxes(grid(np.arange(3.0, length, 4.5), (middle, depth - middle), HEIGHT - 0.03), (1.2, 0.3, 0.06), 0.9)
    for y in np.arange(3.5, depth, 4.0):
        mesh.boxes(grid((middle, length - middle), [y], HEIGHT - 0.03), (0.3, 1.2, 0.06), 0.9)
    for x in np.arange(5.5, length - 3, 6.0):  # beams and a cable tray break the ceiling
        mesh.box((x, middle, HEIGHT - 0.15), (0.3, WIDTH, 0.3), 0.6)
        mesh.box((x + 1.5, depth - middle, HEIGHT - 0.15), (0.3, WIDTH, 0.3), 0.6)
    mesh.box((length / 2, WIDTH - 0.25, HEIGHT - 0.2), (length - 2 * WIDTH, 0.25, 0.08), 0.3)

    first, *others = rectangle(middle, middle, length - middle, depth - middle)
    path = np.array([(middle + 4.0, middle), *others, first])
    someone = props.pedestrian(rectangle(1.85, 1.85, length - 1.85, depth - 1.85)[::-1], 1.1)
    return SimulatedScene(mesh.build(), (someone,), path)


def building(rng: np.random.Generator) -> SimulatedScene:
    """Two wings of office corridors that share one, 138 m a lap: a lap, a turn in the lobby, and the lap reversed."""
    mesh = MeshBuilder()
    reach = 4.2  # rooms behind the outer walls
    storey(mesh, rectangle(-reach, -LOBBY - 0.3, LENGTH + reach, DEPTH + reach), HEIGHT, 0.6, tiled(0.38), 0.7)
    middle, half = LENGTH / 2, WIDTH / 2
    south_wall, *other_walls = sides(rectangle(0, 0, LENGTH, DEPTH))
    _outer_wall(mesh, south_wall[0], (middle - half, 0.0), rng)  # the lobby's entrance stays open
    _outer_wall(mesh, (middle + half, 0.0), south_wall[1], rng)
    for wall in other_walls:
        _outer_wall(mesh, *wall, rng)
    for west, east in ((WIDTH, middle - half), (middle + half, LENGTH - WIDTH)):
        for wall in sides(rectangle(west, WIDTH, east, DEPTH - WIDTH)):
            _inner_wall(mesh, *wall, rng)
    _lobby(mesh, middle, rng)

    mesh.boxes(grid(np.arange(2.5, LENGTH, 4.5), (half, DEPTH - half), HEIGHT - 0.03), (1.2, 0.3, 0.06), 0.9)
    for x in np.cumsum(rng.uniform(3.0, 7.0, 6)):  # beams and cable trays break the ceiling
        mesh.box((x, half, HEIGHT - 0.15), (0.3, WIDTH, 0.3), 0.6)
        mesh.box((LENGTH - x, DEPTH - half, HEIGHT - 0.15), (0.3, WIDTH, 0.3), 0.6)

    south, north, west, east = half, DEPTH - half, half, LENGTH - half
    lap = [
        *((middle, south), (east, south), (east, north), (middle, north), (middle, south)),
        *((west, south), (west, north), (middle, north), (middle, south)),
    ]
    turn = [(middle - 0.3, -1.6), (middle - 1.2, -2.9), (middle, -4.2), (middle + 1.2, -2.9), (middle + 0.3, -1.6)]
    someone = props.pedestrian(rectangle(1.85, 1.85, middle - 1.85, DEPTH - 1.85)[::-1], 1.1)
    # along the shared corridor twice, once from each wing; then the same lap in reverse
    return SimulatedScene(mesh.build(), (someone,), np.array([*lap, *turn, *lap[::-1][:-1]]))


def storeys(rng: np.random.Generator) -> SimulatedScene:
    """Two identical storeys, 46 m a lap, joined by a staircase: a lap below, one above, and another below."""
    east, north, half = 18.0, 10.0, WIDTH / 2
    well = rectangle(east, 3.6, east + 5.8, 6.4)
    one = MeshBuilder()
    storey(one, rectangle(-4.2, -4.2, east + 0.08, north + 4.2), HEIGHT, 0.6, tiled(0.38), 0.7)
    south_wall, east_wall, *other_walls = sides(rectangle(0, 0, east, north))
    for wall in (south_wall, *other_walls):
        _outer_wall(one, *wall, rng)
    one.wall(*east_wall, HEIGHT, 0.65, [(4.4, 5.6, 0.0, 2.1)])  # the door to the stairs
    for wall in sides(rectangle(WIDTH, WIDTH, east - WIDTH, north - WIDTH)):
        _inner_wall(one, *wall, rng)
    one.boxes(grid(np.arange(2.5, east, 4.5), (half, north - half), HEIGHT - 0.03), (1.2, 0.3, 0.06), 0.9)

    mesh = MeshBuilder()
    for floor in (0.0, STOREY):
        mesh.place(one.build(), (0.0, 0.0, floor))
    _staircase(mesh, well, STOREY + HEIGHT)
    lap = [(east - half, 5.0), (east - half, north - half), (half, north - half), (half, half), (east - half, half)]
    up = [(0.5, 1.4), (0.84, 0.7), (4.04, 0.7), (5.0, 0.9), (5.0, 1.9), (4.36, 2.1), (1.16, 2.1), (0.5, 1.4)]
    climb = [0.0, 0.0, 0.5, 0.5, 0.5, 0.5, 1.0, 1.0]
    stairs = np.column_stack([np.array(up) + well[0], np.array(climb) * STOREY])
    below, above = (np.array([(*at, floor) for at in [*lap, lap[0]]]) for floor in (0.0, STOREY))
    return SimulatedScene(mesh.build(), (), np.vstack([below, stairs, above, stairs[::-1], below]), closed=False)


def _staircase(mesh: MeshBuilder, well: list[Point], top: float) -> None:
    """Two flights with a landing between them, in a stairwell that shares its first wall with the storeys."""
    (x, y), (far, _), (_, back), _ = well
    middle = (y + back) / 2
    for wall in sides(well)[:3]:
        mesh.wall(*wall, top, 0.6)
    for z, shade in ((0.0, 0.4), (top, 0.7)):
        mesh.quad([(*corner, z) for corner in well], shade, ground=z == 0.0)
    rise = STOREY / (2 * STEPS)
    for step in range(STEPS):
        ahead, behind = x + 1.0 + RUN * (step + 0.5), x + 1.0 + RUN * (STEPS - step - 0.5)
        _slab(mesh, (ahead, y + 0.7, rise * (step + 1)), (RUN, 1.2, rise))
        _slab(mesh, (behind, back - 0.7, STOREY / 2 + rise * (step + 1)), (RUN, 1.2, rise))
    _slab(mesh, (far - 0.8, middle, STOREY / 2), (1.6, back - y, 0.1))
    _slab(mesh, (x + 0.5, middle, STOREY), (1.0, back - y, 0.1))
    mesh.box((x + 1.0 + RUN * STEPS / 2, middle, STOREY / 2), (RUN * STEPS, 0.05, 1.0), 0.3)


def _slab(mesh: MeshBuilder, top: Triple, size: Triple) -> None:
    """A box whose top, centred at `top`, is a floor."""
    (x, y, z), (length, width, thickness) = top, size
    mesh.box((x, y, z - thickness / 2 - 0.001), size, 0.5)
    corners = rectangle(x - length / 2, y - width / 2, x + length / 2, y + width / 2)
    mesh.quad([(*corner, z) for corner in corners], 0.5, ground=True)


def _outer_wall(mesh: MeshBuilder, start: Point, end: Point, rng: np.random.Generator) -> None:
    """Doors every few metres, some open to a furnished room; pillars and other objects between them."""
    a, along, length, yaw = line_through(start, end)
    outward = np.array([along[1], -along[0]])
    openings = []
    s = rng.uniform(1.6, 2.4)
    while s < length - 3.0:
        openings.append((s, s + 0.9, 0.0, 2.1))
        hinge = a + along * s
        if rng.random() < 0.45:
            props.door_leaf(mesh, (*(hinge + outward * 0.1), 0.0), yaw - rng.uniform(0.9, 1.7))
            _office(mesh, a + along * (s + 0.45), along, outward, rng)
        else:
            props.door_leaf(mesh, (*(hinge + outward * 0.05), 0.0), yaw)
        beside = s + rng.uniform(1.4, 2.0)
        thing = rng.integers(5)
        at = a + along * beside - outward * 0.2
        if thing == 0:
            mesh.box((*at, HEIGHT / 2), (0.4, 0.4, HEIGHT), 0.6, yaw)
        elif thing == 1:
            props.extinguisher(mesh, (*at, 0.0))
        elif thing == 2:
            mesh.box((*(a + along * beside - outward * 0.1), 1.5), (1.0, 0.04, 0.8), 0.35, yaw)
        elif thing == 3:
            props.plant(mesh, (*(at - outward * 0.15), 0.0), rng)
        else:
            props.bench(mesh, (*(at - outward * 0.2), 0.0), yaw + np.pi / 2)
        s += rng.uniform(3.4, 4.6)
    mesh.wall(start, end, HEIGHT, 0.65, openings)


def _inner_wall(mesh: MeshBuilder, start: Point, end: Point, rng: np.random.Generator) -> None:
    """Shallow niches with closed doors, or with windows above radiators."""
    a, along, length, yaw = line_through(start, end)
    inward = np.array([-along[1], along[0]])
    openings = []
    s = rng.uniform(0.8, 2.0)
    while s < length - 2.2:
        middle = a + along * (s + 0.7)
        if rng.random() < 0.5:
            openings.append((s, s + 1.4, 0.9, 2.2))
            mesh.box((*(middle + inward * 0.05), 1.55), (1.4, 0.02, 1.3), 0.02, yaw)
            mesh.box((*(middle - inward * 0.13), 0.45), (1.2, 0.1, 0.6), 0.6, yaw)
        else:
            openings.append((s + 0.25, s + 1.15, 0.0, 2.1))
            mesh.box((*(middle + inward * 0.05), 1.05), (0.9, 0.04, 2.1), rng.uniform(0.3, 0.6), yaw)
        s += rng.uniform(2.6, 4.0)
    mesh.wall(start, end, HEIGHT, 0.6, openings)


def _office(mesh: MeshBuilder, door: F64, along: F64, outward: F64, rng: np.random.Generator) -> None:
    """A small closed room behind a door."""
    half, depth = 1.65, rng.uniform(3.0, 3.8)
    yaw = float(np.arctan2(outward[1], outward[0]))
    left, right = door - along * half, door + along * half
    for start, end in pairwise([left, left + outward * depth, right + outward * depth, right]):
        mesh.wall(start, end, HEIGHT, 0.6, thickness=0.1)
    desk = door + outward * (depth - 1.0) + along * rng.uniform(-0.6, 0.6)
    props.table(mesh, (*desk, 0.0), yaw + np.pi / 2)
    props.chair(mesh, (*(desk - outward * 0.7), 0.0), yaw + rng.uniform(-0.6, 0.6))
    props.shelf(mesh, (*(door + outward * 1.6 + along * (half - 0.25)), 0.0), yaw + np.pi / 2, rng, (1.0, 1.9))


def _lobby(mesh: MeshBuilder, middle: float, rng: np.random.Generator) -> None:
    west, east = middle - 3.6, middle + 3.6
    mesh.wall((west, 0.0), (west, -LOBBY), HEIGHT, 0.6)
    mesh.wall((west, -LOBBY), (east, -LOBBY), HEIGHT, 0.5, [(2.4, 4.8, 0.0, 2.2)])
    mesh.box((middle, -LOBBY - 0.1, 1.1), (2.4, 0.04, 2.2), 0.05)
    mesh.wall((east, -LOBBY), (east, 0.0), HEIGHT, 0.6)
    mesh.wall((west, 0.0), (middle - WIDTH / 2, 0.0), HEIGHT, 0.6)
    mesh.wall((middle + WIDTH / 2, 0.0), (east, 0.0), HEIGHT, 0.6)
    mesh.box((west + 0.8, -3.2, 0.55), (0.7, 2.6, 1.1), 0.5)  # the porter's desk
    props.sofa(mesh, (east - 0.6, -3.0, 0.0), np.pi)
    for at in ((west + 0.5, -5.4, 0.0), (east - 0.5, -5.4, 0.0), (east - 0.5, -0.6, 0.0)):
        props.plant(mesh, at, rng)
