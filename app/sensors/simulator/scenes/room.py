"""One furnished room."""

import numpy as np

from app.sensors.simulator.mesh import MeshBuilder
from app.sensors.simulator.raycast import SimulatedScene
from app.sensors.simulator.scenes import props
from app.sensors.simulator.scenes.plan import level, rectangle, tiled

HEIGHT = 2.8


def room(rng: np.random.Generator) -> SimulatedScene:
    """A furnished room of 12 x 9 m: tables, chairs, shelves, sofas, windows, someone pacing at the far end."""
    length, depth = 12.0, 9.0
    mesh = MeshBuilder()
    mesh.surface(np.arange(0, length + 0.01, 0.5), np.arange(0, depth + 0.01, 0.5), level, tiled(0.45, 0.5))
    mesh.quad([(x, y, HEIGHT) for x, y in rectangle(0, 0, length, depth)], 0.75)

    corners = rectangle(0, 0, length, depth)
    windows = [(s, s + 1.6, 0.9, 2.3) for s in (1.0, 3.6, 6.2, 8.8)]
    mesh.wall(corners[0], corners[1], HEIGHT, 0.65, [(2.2, 3.1, 0.0, 2.1)])
    mesh.wall(corners[1], corners[2], HEIGHT, 0.65)
    mesh.wall(corners[2], corners[3], HEIGHT, 0.65, windows)
    mesh.wall(corners[3], corners[0], HEIGHT, 0.65)
    mesh.box((2.65, -0.05, 1.05), (0.9, 0.05, 2.1), 0.4)
    for s0, s1, bottom, top in windows:
        middle = length - (s0 + s1) / 2
        mesh.box((middle, depth + 0.05, (bottom + top) / 2), (s1 - s0, 0.02, top - bottom), 0.02)
        mesh.box((middle, depth - 0.1, 0.85), (s1 - s0 + 0.2, 0.3, 0.04), 0.6)
        mesh.box((middle, depth - 0.14, 0.45), (s1 - s0, 0.12, 0.6), 0.7)

    for x in (4.0, 6.0):
        props.table(mesh, (x, 4.4, 0.0), rng.uniform(-0.05, 0.05), (1.8, 1.0, 0.74))
        for dx in (-0.45, 0.45):
            props.chair(mesh, (x + dx, 3.55, 0.0), np.pi / 2 + rng.uniform(-0.4, 0.4))
            props.chair(mesh, (x + dx, 5.25, 0.0), -np.pi / 2 + rng.uniform(-0.4, 0.4))
        mesh.box((x + rng.uniform(-0.3, 0.3), 4.4, 0.88), (0.5, 0.04, 0.3), 0.1, rng.uniform(-0.5, 0.5))
        mesh.cylinder((x, 4.4, 2.0), 0.22, 0.2, 0.8, top_radius=0.05)
        mesh.cylinder((x, 4.4, 2.2), 0.01, 0.6, 0.3)
    for y in (1.4, 2.8, 4.2):
        props.shelf(mesh, (0.27, y, 0.0), 0.0, rng)
    props.sofa(mesh, (0.6, 6.6, 0.0))
    mesh.box((1.7, 6.6, 0.2), (0.6, 1.0, 0.4), 0.5, rng.uniform(-0.2, 0.2))
    mesh.box((8.0, 0.12, 1.4), (1.6, 0.06, 0.9), 0.08)
    mesh.box((8.0, 0.3, 0.25), (2.0, 0.45, 0.5), 0.5)
    mesh.box((5.6, 0.3, 0.4), (1.4, 0.5, 0.8), 0.55)
    mesh.box((9.2, 4.5, HEIGHT / 2), (0.45, 0.45, HEIGHT), 0.6)
    for x, y in ((0.5, 0.5), (0.6, 8.4), (11.4, 0.6), (11.4, 8.3), (9.2, 5.2)):
        props.plant(mesh, (x, y, 0.0), rng)
    for x in (2.0, 5.0, 8.0, 11.0):
        for y in (2.0, 7.0):
            mesh.box((x, y, HEIGHT - 0.03), (1.2, 0.6, 0.06), 0.9)
    mesh.box((length / 2, 4.5, HEIGHT - 0.15), (length, 0.35, 0.3), 0.7)
    mesh.box((11.85, 4.4, 1.5), (0.05, 2.4, 1.2), 0.85)

    path = np.array([(3.5, 2.1), (7.4, 2.1), (8.2, 4.4), (7.4, 6.9), (3.2, 6.9), (2.0, 4.4)])
    pacing = props.pedestrian(rectangle(9.8, 2.0, 11.0, 7.0), 0.8)
    return SimulatedScene(mesh.build(), (pacing,), path)
