"""A simulator of the handheld scanner: an RS-Bpearl and an IMU carried through procedural scenes.

`simulate(scene, out, ...)` writes a recording with exact truth; `SCENES` lists the scenes.
"""

from app.sensors.simulator.scenes import SCENES
from app.sensors.simulator.simulate import SimulationSummary, simulate

__all__ = ["SCENES", "SimulationSummary", "simulate"]
