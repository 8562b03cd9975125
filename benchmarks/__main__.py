"""Run benchmarks by name, or all of them: `python -m benchmarks frame`. Some take a recording: `... seek walk.mcap`."""

import os
import sys
from pathlib import Path

from benchmarks import (
    earth,
    export,
    fed,
    frame,
    kill,
    latency,
    live,
    look,
    loops,
    moving,
    packets,
    page,
    replay,
    rewind,
    seek,
    walk,
)
from benchmarks.record import show

BENCHMARKS = {
    "earth": earth.run,
    "export": export.run,
    "fed": fed.run,
    "frame": frame.run,
    "kill": kill.run,
    "latency": latency.run,
    "live": live.run,
    "look": look.run,
    "loops": loops.run,
    "moving": moving.run,
    "packets": packets.run,
    "replay": replay.run,
    "rewind": rewind.run,
    "seek": seek.run,
    "page": page.run,
    "walk": walk.run,
}
ON_A_RECORDING = {"fed": fed.run, "kill": kill.run, "rewind": rewind.run, "seek": seek.run}


def main() -> None:
    *names, last = sys.argv[1:] or list(BENCHMARKS)
    recording = Path(last) if last not in BENCHMARKS and Path(last).exists() else None
    names += [last] if recording is None else []
    if unknown := [name for name in names if name not in BENCHMARKS]:
        sys.exit(f"There is no benchmark {unknown[0]}; choose from {', '.join(BENCHMARKS)}.")
    busy = os.getloadavg()[0]
    if busy > 0.5:
        print(f"Other programs use this machine (load {busy:.1f} on {os.cpu_count()} cores); the times are too long.")
    for name in names:
        show(ON_A_RECORDING[name](recording) if name in ON_A_RECORDING else BENCHMARKS[name]())


if __name__ == "__main__":
    main()
