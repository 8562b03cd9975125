"""The paper's own figures, to compare with ours (Duan et al., ISPRS Archives 2023, Tables 1 to 3)."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Sequence:
    """Attributes:
    frames, duration_s, length_m: Table 1. ate_m, rpe_m: Table 2, by system. runtime_ms: Table 3.
    """

    name: str
    frames: int
    duration_s: float
    length_m: float
    ate_m: dict[str, float]
    rpe_m: dict[str, float]
    runtime_ms: dict[str, float]


_SYSTEMS = ("LOAM", "LIOM", "FAST-LIO", "FAST-LIO-GD", "FAST-LIO-L", "Ours")


def _times(fast_lio: float, ours: float) -> dict[str, float]:
    return {"FAST-LIO": fast_lio, "Ours": ours}


def _errors(*values: float) -> dict[str, float]:
    return dict(zip(_SYSTEMS, values, strict=True))


SEQUENCES: dict[str, Sequence] = {
    "indoor_1": Sequence("Indoor 1", 2266, 226.63, 218.39, {}, {}, _times(28.97, 35.81)),
    "indoor_2": Sequence("Indoor 2", 1252, 125.29, 54.63, {}, {}, _times(27.33, 34.11)),
    "outdoor_1": Sequence("Outdoor 1", 3306, 330.72, 335.59, {}, {}, _times(33.93, 33.46)),
    "outdoor_2": Sequence("Outdoor 2", 3414, 341.45, 422.25, {}, {}, _times(32.89, 33.88)),
    "outdoor_3": Sequence(
        "Outdoor 3",
        9530,
        953.00,
        869.16,
        _errors(35.55, 32.98, 5.04, 4.53, 3.47, 3.45),
        _errors(0.31, 0.25, 0.19, 0.18, 0.19, 0.18),
        _times(21.47, 24.36),
    ),
    "outdoor_4": Sequence(
        "Outdoor 4",
        5667,
        566.75,
        573.64,
        _errors(30.22, 1.25, 2.20, 0.85, 2.67, 0.87),
        _errors(0.24, 0.32, 0.16, 0.03, 0.09, 0.03),
        _times(19.24, 21.17),
    ),
}
"""By the name of our simulated twin. The paper gives errors only for the two sequences with GNSS."""

NOT_COMPARABLE = (
    "The paper ran LOAM, LIOM and FAST-LIO on real recordings, on an Intel i7-8565U. Ours are simulated twins with the"
    " same number of frames, duration and length, on other streets and with exact truth; all variants are this engine"
    " with parts switched off. Compare the order of the columns, and which part helps where. Do not compare the metres"
    " and milliseconds: a simulation has no calibration error, no drifting clock and no GNSS error, and the machine is"
    " another one."
)
