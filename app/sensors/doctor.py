"""The recording doctor: what a recording holds, what was corrected, and what only the user can settle."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the recording doctor.

    Attributes:
        subject: what was looked at, e.g. "point time". verdict: as named.
        text: what was found and how that was decided, in one sentence with units.
        option: the exact option that settles it, e.g. "--set recording.time_unit=us"; "" if none.
    """

    subject: str
    verdict: Literal["fine", "corrected", "needs you"]
    text: str
    option: str = ""
