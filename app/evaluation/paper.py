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

    def ratios(self, errors: dict[str, float]) -> dict[str, float]:
        """Errors divided by the path length, as in Table 2."""
        return {name: error / self.length_m for name, error in errors.items()}


SYSTEMS = ("LOAM", "LIOM", "FAST-LIO", "FAST-LIO-GD", "FAST-LIO-L", "Ours")
_ATE_M = {
    "outdoor_3": (35.55, 32.98, 5.04, 4.53, 3.47, 3.45),
    "outdoor_4": (30.22, 1.25, 2.20, 0.85, 2.67, 0.87),
}
_RPE_M = {"outdoor_3": (0.31, 0.25, 0.19, 0.18, 0.19, 0.18), "outdoor_4": (0.24, 0.32, 0.16, 0.03, 0.09, 0.03)}
"""Errors in the order of SYSTEMS. The paper gives errors only for the two sequences with GNSS."""
_TABLES_1_AND_3 = {
    "indoor_1": (2266, 226.63, 218.39, 28.97, 35.81),
    "indoor_2": (1252, 125.29, 54.63, 27.33, 34.11),
    "outdoor_1": (3306, 330.72, 335.59, 33.93, 33.46),
    "outdoor_2": (3414, 341.45, 422.25, 32.89, 33.88),
    "outdoor_3": (9530, 953.00, 869.16, 21.47, 24.36),
    "outdoor_4": (5667, 566.75, 573.64, 19.24, 21.17),
}
"""Frames, duration in s, length in m; ms per frame of FAST-LIO and of Ours."""

SEQUENCES: dict[str, Sequence] = {
    name: Sequence(
        name.replace("_", " ").capitalize(),
        frames,
        duration_s,
        length_m,
        ate_m=dict(zip(SYSTEMS, _ATE_M.get(name, ()), strict=False)),
        rpe_m=dict(zip(SYSTEMS, _RPE_M.get(name, ()), strict=False)),
        runtime_ms={"FAST-LIO": fast_lio, "Ours": ours},
    )
    for name, (frames, duration_s, length_m, fast_lio, ours) in _TABLES_1_AND_3.items()
}
"""The paper's sequences, by the name of the simulated twin."""

NOT_COMPARABLE = (
    "The paper ran LOAM, LIOM and FAST-LIO on real recordings, on an Intel i7-8565U. Ours are simulated twins with the"
    " same number of frames, duration and length, on other streets and with exact truth. LOAM and LIOM are written"
    " from their papers (`--baseline`); the other columns are this engine with parts switched off. Compare the order of"
    " the columns, and which part helps where. Do not compare the metres and milliseconds: a simulation has no"
    " calibration error, no drifting clock and no GNSS error, and the machine is another one."
)
