"""Procedural scenes: a mesh, moving bodies, and the path of the person with the sensor. One function per scene."""

import difflib
from collections.abc import Callable

import numpy as np

from app.sensors.simulator.raycast import SimulatedScene
from app.sensors.simulator.scenes.cloister import cloister
from app.sensors.simulator.scenes.museum import museum
from app.sensors.simulator.scenes.offices import building, corridor, storeys
from app.sensors.simulator.scenes.outdoors import outdoor, outdoor_1, outdoor_2, outdoor_3, outdoor_4
from app.sensors.simulator.scenes.rooms import flats, identical, indoor_1, indoor_2, room
from app.slam.errors import HemislamError

_BUILDERS: dict[str, Callable[[np.random.Generator], SimulatedScene]] = {
    builder.__name__: builder
    for builder in (
        *(corridor, room, outdoor, museum, cloister, building, storeys, flats, identical),
        *(indoor_1, indoor_2, outdoor_1, outdoor_2, outdoor_3, outdoor_4),
    )
}

SCENES: dict[str, str] = {name: (builder.__doc__ or "").splitlines()[0] for name, builder in _BUILDERS.items()}
"""Name and one-line description of every scene."""


def build_scene(name: str, seed: int) -> SimulatedScene:
    """Build a scene; the same seed gives the same scene. Raises HemislamError, which names the scenes."""
    if name not in _BUILDERS:
        near = difflib.get_close_matches(name, _BUILDERS, n=1)
        hint = f"did you mean `{near[0]}`?" if near else f"there are {', '.join(_BUILDERS)}."
        raise HemislamError(f"There is no scene `{name}`; {hint}")
    return _BUILDERS[name](np.random.default_rng([seed, 0]))
