"""One line of the recording doctor. Both opening and examining a recording produce such lines."""

from dataclasses import dataclass
from typing import Literal

FindingVerdict = Literal["fine", "corrected", "needs you"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the recording doctor.

    Attributes:
        subject: what was examined, e.g. "point time". verdict: see `FindingVerdict`.
        text: what was found and how it was decided, in one sentence with units.
        option: if the verdict is "needs you", the option that settles it, e.g. "--set recording.time_field=none";
            otherwise the option to set in case the finding is wrong. "" if there is nothing to set.
    """

    subject: str
    verdict: FindingVerdict
    text: str
    option: str = ""

    def __str__(self) -> str:
        """Text and option, as one line."""
        use = self.option if self.verdict == "needs you" else f"(if that is wrong: {self.option})"
        return f"{self.text} {use}" if self.option else self.text

    @property
    def spoken(self) -> str:
        """Text and option, also for readers of the page, who may not see a command line."""
        if not self.option:
            return self.text
        settle = f"start hemislam with {self.option}"
        return f"{self.text}; {settle}" if self.verdict == "needs you" else f"{self.text} (if that is wrong, {settle})"

    @property
    def sentence(self) -> str:
        """The text for a notification on the page, where the options are under Recording."""
        said = f"{self.subject[:1].upper()}{self.subject[1:]}: {self.text.rstrip('.')}."
        return f"{said} Settle it under Recording." if self.option else said
