"""A trap for place recognition: every corridor and every room has twins."""

import numpy as np

from app.sensors.simulator.mesh import MeshBuilder
from app.sensors.simulator.raycast import SimulatedScene
from app.sensors.simulator.scenes import props
from app.sensors.simulator.scenes.plan import level, rectangle, tiled

HEIGHT, WIDTH = 2.6, 2.0
PITCH, CORRIDORS = 6.0, 5
"""Distance between the middles of neighbouring corridors, m, and how many there are."""
BAY, BAYS = 4.0, 4
"""Distance from door to door along a corridor, m, and how many there are on either side."""


def identical(rng: np.random.Generator) -> SimulatedScene:
    """Five identical corridors side by side, each with eight identical rooms, walked one after the other."""
    mesh = MeshBuilder()
    width = (CORRIDORS - 1) * PITCH
    far = BAYS * BAY + WIDTH  # between the middles of the two aisles that join the corridors
    half = WIDTH / 2
    west, east, south, north = -PITCH / 2, width + PITCH / 2, -half, far + half
    mesh.surface(np.arange(west, east + 0.01, 0.5), np.arange(south, north + 0.01, 0.5), level, tiled(0.4))
    mesh.quad([(x, y, HEIGHT) for x, y in rectangle(west, south, east, north)], 0.7)
    outline = rectangle(west, south, east, north)
    for k in range(4):
        mesh.wall(outline[k], outline[(k + 1) % 4], HEIGHT, 0.6)
    for c in range(CORRIDORS):
        for side in (-1.0, 1.0):
            for bay in range(BAYS):
                _room(mesh, c * PITCH + side * half, side, half + bay * BAY)
        for y in (0.0, far):  # the same lamp and the same bench across each corridor's mouth
            mesh.box((c * PITCH, y, HEIGHT - 0.05), (0.3, 1.2, 0.1), 0.9)
        for y in np.arange(half + BAY / 2, far, BAY):
            mesh.box((c * PITCH, y, HEIGHT - 0.05), (0.3, 1.2, 0.1), 0.9)
    path = []
    for c in range(CORRIDORS):
        x, ends = c * PITCH, (0.0, far)
        path += [(x, y) for y in (ends if c % 2 == 0 else ends[::-1])]
    # the last corridor ends in the north: back along the north aisle and down the first corridor
    return SimulatedScene(mesh.build(), (), np.array([*path, (0.0, far)]))


def _room(mesh: MeshBuilder, x: float, side: float, y: float) -> None:
    """One bay: a wall with an open door, and behind it a room with a table, a chair and a box.

    Args:
        x: of the wall. side: +1 if the room lies towards +x, else -1. y: where the bay begins.
    """
    mesh.wall((x, y), (x, y + BAY), HEIGHT, 0.6, [(1.2, 2.3, 0.0, 2.1)], thickness=0.12)
    back = x + side * (PITCH / 2 - WIDTH / 2)
    mesh.wall((back, y), (back, y + BAY), HEIGHT, 0.6, thickness=0.1)
    for end in (y, y + BAY):
        mesh.wall((x, end), (back, end), HEIGHT, 0.6, thickness=0.1)
    props.table(mesh, (x + side * 1.4, y + 2.9, 0.0), np.pi / 2, (1.4, 0.7, 0.74))
    props.chair(mesh, (x + side * 0.8, y + 2.9, 0.0), 0.0 if side < 0 else np.pi)
    mesh.box((x + side * 1.5, y + 0.5, 0.6), (0.6, 0.5, 1.2), 0.4)
