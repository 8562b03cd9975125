"""A campus under the open sky."""

import numpy as np

from app.sensors.simulator.mesh import MeshBuilder
from app.sensors.simulator.raycast import SimulatedScene
from app.sensors.simulator.scenes import props
from app.sensors.simulator.scenes.plan import distance_to_path
from app.slam.types import F64

ASPHALT, GRASS = 0.18, 0.42


def outdoor(rng: np.random.Generator) -> SimulatedScene:
    """A campus with slopes, buildings, trees, hedges, parked cars and people who walk about."""
    mesh = MeshBuilder()
    path = np.array(
        [
            *((-14.0, -13.0), (0.0, -15.0), (14.0, -12.0), (22.0, -3.0), (19.0, 8.0)),
            *((8.0, 13.0), (-7.0, 11.0), (-20.0, 12.0), (-25.0, 2.0), (-22.0, -8.0)),
        ]
    )
    phase = rng.uniform(0, 2 * np.pi, 4)

    def height(xy: F64) -> F64:
        x, y = xy.T
        slopes = 1.3 * np.sin(x / 17.0 + phase[0]) + 1.0 * np.cos(y / 13.0 + phase[1]) + 0.015 * x
        bumps = 0.03 * np.sin(x / 1.3 + phase[2]) * np.sin(y / 1.7 + phase[3])
        return np.asarray(slopes + bumps)

    def shade(xy: F64) -> F64:
        return np.where(distance_to_path(xy, path) < 1.6, ASPHALT, GRASS)

    def at(x: float, y: float) -> tuple[float, float, float]:
        return x, y, float(height(np.array([[x, y]]))[0])

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
        off = float(distance_to_path(np.array([[x, y]]), path)[0])
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
