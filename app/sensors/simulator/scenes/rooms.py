"""Indoor scenes: a furnished room, a garage and an office as in the paper, and two sets of identical places."""

import numpy as np

from app.sensors.simulator.mesh import MeshBuilder
from app.sensors.simulator.raycast import SimulatedScene
from app.sensors.simulator.scenes import props
from app.sensors.simulator.scenes.props import grid, rectangle, sides, storey, tiled

HEIGHT, WIDTH = 2.6, 2.0
"""m, width and height of the corridors of `identical`."""
PITCH, CORRIDORS = 6.0, 5
"""Distance between the middles of neighbouring corridors, m, and number of corridors."""
BAY, BAYS = 4.0, 4
"""Distance from door to door along a corridor, m, and number of doors on either side."""
FLAT, FLATS, FLAT_DEPTH = 7.0, 3, 9.0
"""Width of each of the `flats` (m), their number, and their depth (m)."""


def room(rng: np.random.Generator) -> SimulatedScene:
    """A furnished room of 12 x 9 m: tables, chairs, shelves, sofas, windows, and a person pacing at the far end."""
    length, depth, height = 12.0, 9.0, 2.8
    mesh = MeshBuilder()
    corners = rectangle(0, 0, length, depth)
    storey(mesh, corners, height, 0.5, tiled(0.45, 0.5), 0.75)
    windows = [(s, s + 1.6, 0.9, 2.3) for s in (1.0, 3.6, 6.2, 8.8)]
    for wall, openings in zip(sides(corners), ([(2.2, 3.1, 0.0, 2.1)], [], windows, []), strict=True):
        mesh.wall(*wall, height, 0.65, openings)
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
    mesh.box((9.2, 4.5, height / 2), (0.45, 0.45, height), 0.6)
    for x, y in ((0.5, 0.5), (0.6, 8.4), (11.4, 0.6), (11.4, 8.3), (9.2, 5.2)):
        props.plant(mesh, (x, y, 0.0), rng)
    mesh.boxes(grid((2.0, 5.0, 8.0, 11.0), (2.0, 7.0), height - 0.03), (1.2, 0.6, 0.06), 0.9)
    mesh.box((length / 2, 4.5, height - 0.15), (length, 0.35, 0.3), 0.7)
    mesh.box((11.85, 4.4, 1.5), (0.05, 2.4, 1.2), 0.85)

    path = np.array([(3.5, 2.1), (7.4, 2.1), (8.2, 4.4), (7.4, 6.9), (3.2, 6.9), (2.0, 4.4)])
    pacing = props.pedestrian(rectangle(9.8, 2.0, 11.0, 7.0), 0.8)
    return SimulatedScene(mesh.build(), (pacing,), path)


def indoor_1(rng: np.random.Generator) -> SimulatedScene:
    """A parking garage of 44 x 26 m: pillars, beams, rows of cars, two lanes and a cross lane, 232 m a lap."""
    length, depth, height = 44.0, 26.0, 2.6
    mesh = MeshBuilder()
    corners = rectangle(0, 0, length, depth)
    storey(mesh, corners, height, 1.0, tiled(0.3, 2.0), 0.5)
    for wall in sides(corners):
        mesh.wall(*wall, height, 0.55, [(s, s + 0.9, 0.0, 2.1) for s in (6.0, 21.0)])
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
    mesh.boxes(grid(np.arange(3.0, length, 6.0), (7.0, 19.0), height - 0.06), (0.15, 1.3, 0.12), 0.9)

    small = [(5.0, 7.0), (17.0, 7.0), (17.0, 19.0), (5.0, 19.0), (5.0, 7.0)]
    rest = [(39.0, 7.0), (39.0, 19.0), (5.0, 19.0), (5.0, 7.0), (17.0, 7.0), (17.0, 19.0), (39.0, 19.0), (39.0, 7.0)]
    someone = props.pedestrian(rectangle(20.0, 6.0, 41.0, 20.2), 1.1)
    return SimulatedScene(mesh.build(), (someone,), np.array([*small, *rest]))


def indoor_2(rng: np.random.Generator) -> SimulatedScene:
    """An open-plan office of 14 x 10 m: islands of desks, chairs at all angles, shelves, sofas, 24 m a lap."""
    length, depth, height = 14.0, 10.0, 2.8
    mesh = MeshBuilder()
    corners = rectangle(0, 0, length, depth)
    storey(mesh, corners, height, 0.5, tiled(0.4, 0.5), 0.75)
    windows = [(s, s + 1.5, 0.9, 2.3) for s in np.arange(1.0, length - 2.0, 2.6)]
    door = [(2.0, 2.9, 0.0, 2.1)]
    for wall, openings in zip(sides(corners), (door, door, windows, door), strict=True):
        mesh.wall(*wall, height, 0.65, openings)
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
    mesh.boxes(grid(np.arange(1.5, length, 3.0), (2.5, 7.5), height - 0.03), (1.2, 0.6, 0.06), 0.9)
    path = np.array(rectangle(2.4, 2.3, 9.6, 7.3))
    pacing = props.pedestrian(rectangle(10.4, 1.5, 11.6, 8.5), 0.7)
    return SimulatedScene(mesh.build(), (pacing,), path)


def identical(rng: np.random.Generator) -> SimulatedScene:
    """Five identical corridors side by side, each with eight identical rooms, walked one after the other."""
    mesh = MeshBuilder()
    width = (CORRIDORS - 1) * PITCH
    far = BAYS * BAY + WIDTH  # between the middles of the two aisles that join the corridors
    half = WIDTH / 2
    outline = rectangle(-PITCH / 2, -half, width + PITCH / 2, far + half)
    storey(mesh, outline, HEIGHT, 0.5, tiled(0.4), 0.7)
    for wall in sides(outline):
        mesh.wall(*wall, HEIGHT, 0.6)
    for c in range(CORRIDORS):
        for side in (-1.0, 1.0):
            for bay in range(BAYS):
                _bay(mesh, c * PITCH + side * half, side, half + bay * BAY)
        lamps = grid([c * PITCH], (0.0, far, *np.arange(half + BAY / 2, far, BAY)), HEIGHT - 0.05)
        mesh.boxes(lamps, (0.3, 1.2, 0.1), 0.9)
    path = []
    for c in range(CORRIDORS):
        x, ends = c * PITCH, (0.0, far)
        path += [(x, y) for y in (ends if c % 2 == 0 else ends[::-1])]
    # the last corridor ends in the north: return along the north aisle and the first corridor
    return SimulatedScene(mesh.build(), (), np.array([*path, (0.0, far)]))


def flats(rng: np.random.Generator) -> SimulatedScene:
    """Three identical flats in a row, joined by a gallery: each is toured twice, then the first again."""
    one, width = MeshBuilder(), FLATS * FLAT
    for wall, openings in (
        (((0.0, 0.0), (FLAT, 0.0)), [(0.8, 2.4, 0.0, 2.1), (3.6, 5.4, 0.9, 2.2)]),
        (((0.0, FLAT_DEPTH), (FLAT, FLAT_DEPTH)), [(0.8, 2.4, 0.9, 2.2), (4.2, 6.0, 0.2, 2.2)]),
        (((0.0, 4.6), (FLAT, 4.6)), [(4.6, 6.2, 0.0, 2.1)]),
        (((2.8, 4.6), (2.8, FLAT_DEPTH)), [(1.9, 3.5, 0.0, 2.1)]),
        (((FLAT, 0.0), (FLAT, FLAT_DEPTH)), []),
    ):
        one.wall(*wall, HEIGHT, 0.6, openings, thickness=0.12)
    props.table(one, (5.3, 1.6, 0.0), 0.2)
    for x, yaw in ((4.5, 0.1), (6.2, 3.0)):
        props.chair(one, (x, 1.4, 0.0), yaw)
    props.shelf(one, (0.3, 2.8, 0.0), 0.0, rng)
    props.sofa(one, (3.6, 8.2, 0.0), -np.pi / 2)
    props.plant(one, (6.5, 4.0, 0.0), rng)
    one.box((0.8, 8.4, 0.3), (1.4, 1.0, 0.6), 0.5)
    one.box((1.3, 5.0, 1.0), (1.2, 0.6, 2.0), 0.6)

    mesh = MeshBuilder()
    storey(mesh, rectangle(-3.0, -2.2, width + 3.0, FLAT_DEPTH), HEIGHT, 0.5, tiled(0.4), 0.7)
    flat = one.build()
    for index in range(FLATS):
        mesh.place(flat, (index * FLAT, 0.0, 0.0))
    mesh.wall((0.0, 0.0), (0.0, FLAT_DEPTH), HEIGHT, 0.6)
    mesh.wall((-3.0, -2.2), (width + 3.0, -2.2), 1.0, 0.5)
    tour = [(1.6, 1.4), (3.6, 3.1), (5.4, 3.6), (5.4, 6.4), (2.1, 7.2), (5.4, 6.6), (5.4, 3.4), (3.2, 2.9)]
    visit = [(1.6, -1.1), *tour, *tour, (1.6, 1.2), (1.6, -1.1)]
    rooms = [(x + index * FLAT, y) for index in (*range(FLATS), 0) for x, y in visit]
    return SimulatedScene(mesh.build(), (), np.array([(-2.0, -1.1), *rooms]), closed=False)


def _bay(mesh: MeshBuilder, x: float, side: float, y: float) -> None:
    """A bay: a wall with an open door, and behind it a room with a table, a chair and a box.

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
