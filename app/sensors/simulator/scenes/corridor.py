"""A loop of corridors in an office building."""

import numpy as np

from app.sensors.simulator.mesh import MeshBuilder
from app.sensors.simulator.raycast import SimulatedScene
from app.sensors.simulator.scenes import props
from app.sensors.simulator.scenes.plan import level, rectangle, tiled
from app.slam.types import F64

HEIGHT = 2.7
WIDTH = 2.4


def corridor(rng: np.random.Generator) -> SimulatedScene:
    """A 24 x 14 m loop of office corridors: doors, open rooms, pillars, ceiling lamps, a person walking."""
    length, depth = 24.0, 14.0
    mesh = MeshBuilder()
    reach = 4.2  # rooms behind the outer walls
    mesh.surface(
        np.arange(-reach, length + reach + 0.01, 0.6),
        np.arange(-reach, depth + reach + 0.01, 0.6),
        level,
        tiled(0.38),
    )
    mesh.quad([(x, y, HEIGHT) for x, y in rectangle(-reach, -reach, length + reach, depth + reach)], 0.7)

    outer = rectangle(0, 0, length, depth)
    inner = rectangle(WIDTH, WIDTH, length - WIDTH, depth - WIDTH)
    for k in range(4):
        outer_wall(mesh, outer[k], outer[(k + 1) % 4], rng)
        inner_wall(mesh, inner[k], inner[(k + 1) % 4], rng)

    middle = WIDTH / 2
    for x in np.arange(3.0, length, 4.5):
        for y in (middle, depth - middle):
            mesh.box((x, y, HEIGHT - 0.03), (1.2, 0.3, 0.06), 0.9)
    for y in np.arange(3.5, depth, 4.0):
        for x in (middle, length - middle):
            mesh.box((x, y, HEIGHT - 0.03), (0.3, 1.2, 0.06), 0.9)
    for x in np.arange(5.5, length - 3, 6.0):  # beams and a cable tray break the ceiling
        mesh.box((x, middle, HEIGHT - 0.15), (0.3, WIDTH, 0.3), 0.6)
        mesh.box((x + 1.5, depth - middle, HEIGHT - 0.15), (0.3, WIDTH, 0.3), 0.6)
    mesh.box((length / 2, WIDTH - 0.25, HEIGHT - 0.2), (length - 2 * WIDTH, 0.25, 0.08), 0.3)

    path = np.array(rectangle(middle, middle, length - middle, depth - middle))
    start = np.array([[middle + 4.0, middle]])
    walk = np.vstack([start, path[1:], path[:1]])
    someone = props.pedestrian(rectangle(1.85, 1.85, length - 1.85, depth - 1.85)[::-1], 1.1)
    return SimulatedScene(mesh.build(), (someone,), walk)


def outer_wall(
    mesh: MeshBuilder, start: tuple[float, float], end: tuple[float, float], rng: np.random.Generator
) -> None:
    """Doors every few metres, some open to a furnished room; pillars and odds and ends between them."""
    a, b = np.array(start), np.array(end)
    length = float(np.linalg.norm(b - a))
    along = (b - a) / length
    outward = np.array([along[1], -along[0]])
    yaw = float(np.arctan2(along[1], along[0]))

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


def inner_wall(
    mesh: MeshBuilder, start: tuple[float, float], end: tuple[float, float], rng: np.random.Generator
) -> None:
    """Shallow niches with closed doors or panes, radiators under them."""
    a, b = np.array(start), np.array(end)
    length = float(np.linalg.norm(b - a))
    along = (b - a) / length
    inward = np.array([-along[1], along[0]])
    yaw = float(np.arctan2(along[1], along[0]))
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


def _office(
    mesh: MeshBuilder,
    door: F64,
    along: F64,
    outward: F64,
    rng: np.random.Generator,
) -> None:
    """A small room behind a door, closed all round."""
    half, depth = 1.65, rng.uniform(3.0, 3.8)
    yaw = float(np.arctan2(outward[1], outward[0]))
    corners = [door - along * half, door - along * half + outward * depth]
    corners += [door + along * half + outward * depth, door + along * half]
    for k in range(3):
        mesh.wall(corners[k], corners[k + 1], HEIGHT, 0.6, thickness=0.1)
    desk = door + outward * (depth - 1.0) + along * rng.uniform(-0.6, 0.6)
    props.table(mesh, (*desk, 0.0), yaw + np.pi / 2)
    props.chair(mesh, (*(desk - outward * 0.7), 0.0), yaw + rng.uniform(-0.6, 0.6))
    props.shelf(mesh, (*(door + outward * 1.6 + along * (half - 0.25)), 0.0), yaw + np.pi / 2, rng, (1.0, 1.9))
