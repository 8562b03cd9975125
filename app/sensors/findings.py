"""One line of the recording doctor: the value that probing a recording and examining it both produce."""

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["fine", "corrected", "needs you"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the recording doctor.

    Attributes:
        subject: what was looked at, e.g. "point time". verdict: as named.
        text: what was found and how that was decided, in one sentence with units.
        option: the exact option that settles it, e.g. "--set recording.time_unit=us"; "" if none.
    """

    subject: str
    verdict: Verdict
    text: str
    option: str = ""
