"""Variants that run on the same recording: sets of parameters, such as the paper's ablation, and other systems."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from app.baselines.systems import find_system
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.user_text import read_assignments

LOOPS = "loops.enabled"


@dataclass(frozen=True, slots=True)
class Variant:
    """Attributes:
    name: column of the tables. values: parameters by dotted name that replace those of the recording.
    meaning: in words. baseline: name of the system that replaces the engine; "" for the engine.
    """

    name: str
    values: Mapping[str, Any]
    meaning: str = ""
    baseline: str = ""

    def applied(self, params: Params) -> Params:
        """`params` with this variant's values.

        Raises:
            HemislamError: a parameter is unknown or out of range.
        """
        try:
            return params.with_values(self.values)
        except HemislamError as error:
            raise HemislamError(f"Variant {self.name}: {error}") from None


PAPER: tuple[Variant, ...] = (
    Variant("FAST-LIO", {"ground.enabled": False, LOOPS: False}, "no ground downsampling, no loops"),
    Variant("FAST-LIO-GD", {"ground.enabled": True, LOOPS: False}, "ground downsampling, no loops"),
    Variant("FAST-LIO-L", {"ground.enabled": False, LOOPS: True}, "loops, no ground downsampling"),
    Variant("Ours", {"ground.enabled": True, LOOPS: True}, "ground downsampling and loops"),
)
"""The ablation of the paper's Table 2: this engine with parts of it switched off."""


def parse_variant(text: str) -> Variant:
    """A variant from `NAME:section.name=value,section.name=value`. Values are YAML; lists in brackets may hold commas.

    Raises:
        HemislamError: the text does not have this form.
    """
    name, colon, rest = (part.strip() for part in text.partition(":"))
    example = "--variant NAME:ground.sigma=0.03,ground.alpha=30"
    if not (name and colon):
        raise HemislamError(f"`--variant {text}` has no name; write it as `{example}`.")
    values = read_assignments(re.split(r",(?![^\[]*\])", rest), "--variant", example)
    if not re.fullmatch(r"[\w.+-]+", name) or name.startswith("."):
        raise HemislamError(f"A variant cannot be named `{name}`; use letters, digits, `-`, `_`, `.` and `+`.")
    return Variant(name, values, ", ".join(f"{path} = {value}" for path, value in values.items()))


def baseline_variant(name: str) -> Variant:
    """A variant that runs another system.

    Raises:
        HemislamError: there is no system of this name, or it is not installed.
    """
    system = find_system(name)
    return Variant(system.title, {}, ", version ".join(filter(None, (system.meaning, system.version()))), baseline=name)


def choose_variants(own: list[Variant], *, ablation: bool, baselines: Sequence[str] = ()) -> list[Variant]:
    """The other systems, the paper's ablation (if wanted) and the user's variants: columns as in the paper's Table 2.

    Raises:
        HemislamError: two variants have the same name, or there is no variant.
    """
    chosen = [*map(baseline_variant, baselines), *(PAPER if ablation else ()), *own]
    names = [variant.name for variant in chosen]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise HemislamError(f"There are two variants named {twice}; name each only once.")
    if not chosen:
        raise HemislamError("There is no variant to run; leave out --no-ablation, or add a --variant or --baseline.")
    return chosen
