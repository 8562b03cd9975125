"""`python -m benchmarks.fuzz --seconds 60`: damaged input of every kind, until the time is over.

python -m benchmarks.fuzz --seconds 600 --only recordings
python -m benchmarks.fuzz --case packets:17        one case again
"""

import argparse
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable
from itertools import count
from pathlib import Path

from tqdm import tqdm

from benchmarks.fuzz import inputs
from benchmarks.fuzz.recordings import Recordings
from benchmarks.fuzz.rest import REQUESTS_AT_ONCE, Rest

SEEDS = Path(__file__).with_name("seeds.txt")
"""`KIND:SEED` of the cases that once broke an invariant, one per line."""
MOST_NEW = 5
"""Most cases that one run adds to this file."""
WORTH = {"recordings": 1, "packets": 2, "rest": 2, "session": 5, "text": 5, "page": 20}
"""How many cases of each kind are tried in turn, so that all kinds take about equally long."""
EACH = {"packets": f" of {inputs.PACKETS_AT_ONCE} packets", "rest": f" of {REQUESTS_AT_ONCE} requests"}


class Fuzzer:
    """Tries cases by name. A context manager."""

    def __init__(self) -> None:
        self._recordings = Recordings()
        self._rest = Rest(self._recordings.good)
        self._kinds: dict[str, Callable[[int], str]] = {
            "recordings": self._recordings.broken,
            "packets": lambda seed: inputs.packets(seed, self._recordings.packets[seed % 3]),
            "rest": self._rest.broken,
            "session": lambda seed: inputs.session(seed, self._recordings.good),
            "text": inputs.text,
            "page": inputs.page,
        }

    def __enter__(self) -> "Fuzzer":
        return self

    def __exit__(self, *_: object) -> None:
        self._rest.close()
        self._recordings.close()

    def broken(self, case: str) -> str:
        """The invariant that this case breaks, and how; "" if none. `case`: KIND:SEED."""
        kind, _, seed = case.partition(":")
        try:
            return self._kinds[kind](int(seed))
        except Exception:
            return traceback.format_exc()


def kept() -> list[str]:
    return SEEDS.read_text(encoding="utf-8").split() if SEEDS.exists() else []


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fuzz", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="how long; 60 by default")
    parser.add_argument("--only", choices=WORTH, help="one kind of input")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--case", help="one case again, such as recordings:17")
    parser.add_argument("--kept", action="store_true", help="the kept cases and the first few of each kind")
    chosen = parser.parse_args()
    with Fuzzer() as fuzzer:
        if chosen.case:
            found = fuzzer.broken(chosen.case)
            print(found or "It holds.")
            return bool(found)
        if chosen.kept:
            cases = [*kept(), *(f"{kind}:{seed}" for kind, worth in WORTH.items() for seed in range(2 * worth))]
            wrong = {case: found for case in cases if (found := fuzzer.broken(case))}
            print(*(f"{case}  {found}" for case, found in wrong.items()), f"{len(cases)} cases", sep="\n")
            return bool(wrong)
        kinds = [chosen.only] if chosen.only else [*WORTH]
        tried, broken = Counter[str](), []
        seeds, until = {kind: count(chosen.first) for kind in kinds}, time.monotonic() + chosen.seconds
        with tqdm(unit=" cases") as bar:
            while time.monotonic() < until:
                for kind in [name for name in kinds for _ in range(WORTH[name])]:
                    case = f"{kind}:{next(seeds[kind])}"
                    tried[kind] += 1
                    bar.update()
                    if found := fuzzer.broken(case):
                        broken.append(case)
                        tqdm.write(f"{case}  {found}\n")
    for kind in kinds:
        failures = sum(case.startswith(f"{kind}:") for case in broken)
        each = EACH.get(kind, "")
        print(f"{kind:12} {tried[kind]:7,} cases{each}, {failures} break an invariant")
    if new := [case for case in broken if case not in kept()][:MOST_NEW]:
        with SEEDS.open("a", encoding="utf-8") as file:
            file.writelines(f"{case}\n" for case in new)
        print(f"Added to {SEEDS.name}: {', '.join(new)}")
    return bool(broken)


if __name__ == "__main__":
    sys.exit(main())
