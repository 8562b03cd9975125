"""The address at which the receiving process of a live source is polled."""

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import Final

TITLE: Final = "The process that receives live data"
ENDED: Final = f"{TITLE} has ended; start hemislam again."


@dataclass(frozen=True, slots=True)
class LiveAddress:
    """Where a `LiveProcess` is polled; passed to the engine's process."""

    path: str
    key: bytes

    def end(self, reason: str) -> None:
        """Record that nothing will answer at this address any more. The first reason counts."""
        with contextlib.suppress(OSError), Path(f"{self.path}.ended").open("x", encoding="utf-8") as file:
            file.write(reason)

    def ended(self) -> str:
        """Why nothing will answer at this address any more; "" while something may."""
        try:
            return Path(f"{self.path}.ended").read_text(encoding="utf-8") or ENDED
        except OSError:
            return "" if Path(self.path).parent.is_dir() else ENDED
