"""A storey with two wings, walked both ways."""

import numpy as np

from app.sensors.simulator.mesh import MeshBuilder
from app.sensors.simulator.raycast import SimulatedScene
from app.sensors.simulator.scenes import props
from app.sensors.simulator.scenes.corridor import HEIGHT, WIDTH, inner_wall, outer_wall
from app.sensors.simulator.scenes.plan import level, rectangle, tiled

LENGTH, DEPTH = 42.0, 15.0
_LOBBY = 6.0


def building(rng: np.random.Generator) -> SimulatedScene:
    """Two wings of office corridors that share one, 138 m a lap: one lap, a turn in the lobby, and all of it back."""
    mesh = MeshBuilder()
    reach = 4.2  # rooms behind the outer walls
    x_floor = np.arange(-reach, LENGTH + reach + 0.01, 0.6)
    mesh.surface(x_floor, np.arange(-_LOBBY - 0.3, DEPTH + reach + 0.01, 0.6), level, tiled(0.38))
    mesh.quad([(x, y, HEIGHT) for x, y in rectangle(-reach, -_LOBBY - 0.3, LENGTH + reach, DEPTH + reach)], 0.7)

    middle, half = LENGTH / 2, WIDTH / 2
    outline = rectangle(0, 0, LENGTH, DEPTH)
    # the south wall leaves the lobby's entrance open
    outer_wall(mesh, outline[0], (middle - half, 0.0), rng)
    outer_wall(mesh, (middle + half, 0.0), outline[1], rng)
    for k in (1, 2, 3):
        outer_wall(mesh, outline[k], outline[(k + 1) % 4], rng)
    for west, east in ((WIDTH, middle - half), (middle + half, LENGTH - WIDTH)):
        block = rectangle(west, WIDTH, east, DEPTH - WIDTH)
        for k in range(4):
            inner_wall(mesh, block[k], block[(k + 1) % 4], rng)
    _lobby(mesh, middle, rng)

    for x in np.arange(2.5, LENGTH, 4.5):
        for y in (half, DEPTH - half):
            mesh.box((x, y, HEIGHT - 0.03), (1.2, 0.3, 0.06), 0.9)
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
    # down the shared corridor twice, once from either wing; then the same lap the other way
    return SimulatedScene(mesh.build(), (someone,), np.array([*lap, *turn, *lap[::-1][:-1]]))


def _lobby(mesh: MeshBuilder, middle: float, rng: np.random.Generator) -> None:
    west, east = middle - 3.6, middle + 3.6
    mesh.wall((west, 0.0), (west, -_LOBBY), HEIGHT, 0.6)
    mesh.wall((west, -_LOBBY), (east, -_LOBBY), HEIGHT, 0.5, [(2.4, 4.8, 0.0, 2.2)])
    mesh.box((middle, -_LOBBY - 0.1, 1.1), (2.4, 0.04, 2.2), 0.05)
    mesh.wall((east, -_LOBBY), (east, 0.0), HEIGHT, 0.6)
    mesh.wall((west, 0.0), (middle - WIDTH / 2, 0.0), HEIGHT, 0.6)
    mesh.wall((middle + WIDTH / 2, 0.0), (east, 0.0), HEIGHT, 0.6)
    mesh.box((west + 0.8, -3.2, 0.55), (0.7, 2.6, 1.1), 0.5)  # the porter's desk
    props.sofa(mesh, (east - 0.6, -3.0, 0.0), np.pi)
    for at in ((west + 0.5, -5.4, 0.0), (east - 0.5, -5.4, 0.0), (east - 0.5, -0.6, 0.0)):
        props.plant(mesh, at, rng)
