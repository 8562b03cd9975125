"""One line of the recording doctor, as both opening and examining a recording produce it."""

from dataclasses import dataclass
from typing import Literal

FindingVerdict = Literal["fine", "corrected", "needs you"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the recording doctor.

    Attributes:
        subject: what was examined, e.g. "point time". verdict: see `FindingVerdict`.
        text: what was found and how it was decided, in one sentence with units.
        option: the option that settles it, e.g. "--set recording.time_unit=us"; "" if none.
    """

    subject: str
    verdict: FindingVerdict
    text: str
    option: str = ""
