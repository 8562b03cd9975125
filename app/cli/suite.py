"""Makes a suite of simulated recordings behind a progress bar, for `simulate` and `evaluate`."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from app.cli.options import progress_bar
from app.slam.text_files import make_folder

if TYPE_CHECKING:
    from app.sensors.simulator.imperfections import Imperfections


def make_suite(
    name: str,
    folder: Path,
    seeds: list[int],
    *,
    short: bool,
    imperfections: "Imperfections",
    every_block: int | None = None,
) -> list[Path]:
    """Make the recordings that do not exist yet, and return all of them.

    Raises:
        HemislamError: there is no such suite, or the recordings cannot be written.
    """
    from app.sensors.simulator.suite import find_suite, make_twin

    twins = find_suite(name)
    make_folder(folder)
    recordings = []
    for seed in seeds:
        for twin in twins:
            with progress_bar(f"{twin.name}, seed {seed}", unit=" scans") as show:
                made = make_twin(
                    twin,
                    folder,
                    seed=seed,
                    short=short,
                    every_block=every_block,
                    imperfections=imperfections,
                    progress=show,
                )
            state = "made" if made.new else "exists already"
            typer.echo(f"{made.recording}: {made.distance_m:.1f} m walked, {state}")
            recordings.append(made.recording)
    return recordings
