"""A simulator of the handheld scanner: a LiDAR and an IMU carried through procedural scenes.

`simulate(scene, out, ...)` writes a recording with exact truth; `SCENES` lists the scenes, `SCANNERS` the scanners.
"""

from app.sensors.simulator.scanners import SCANNERS
from app.sensors.simulator.scenes import SCENES
from app.sensors.simulator.simulate import SimulationSummary, simulate

__all__ = ["SCANNERS", "SCENES", "SimulationSummary", "simulate"]
