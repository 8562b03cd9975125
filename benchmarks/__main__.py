"""Run the benchmarks by name, or all: `python -m benchmarks frame`."""

import os
import sys

from benchmarks import frame, latency, live, loops, packets, page, replay, seek, walk
from benchmarks.record import show

BENCHMARKS = {
    "frame": frame.run,
    "latency": latency.run,
    "live": live.run,
    "loops": loops.run,
    "packets": packets.run,
    "replay": replay.run,
    "seek": seek.run,
    "page": page.run,
    "walk": walk.run,
}


def main() -> None:
    names = sys.argv[1:] or list(BENCHMARKS)
    if unknown := [name for name in names if name not in BENCHMARKS]:
        sys.exit(f"There is no benchmark {unknown[0]}; choose from {', '.join(BENCHMARKS)}.")
    busy = os.getloadavg()[0]
    if busy > 0.5:
        print(f"Other programs keep this machine busy (load {busy:.1f} on {os.cpu_count()} cores); times mislead.")
    for name in names:
        show(BENCHMARKS[name]())


if __name__ == "__main__":
    main()
