"""Makes the paper's suite of simulated recordings behind a progress bar, for `simulate` and `evaluate`."""

from pathlib import Path

import typer

from app.slam.errors import HemislamError


def make_suite(
    name: str, folder: Path, seeds: list[int], *, short: bool = False, every_block: int | None = None
) -> list[Path]:
    """Make the recordings that do not exist yet, and return all of them.

    Raises:
        HemislamError: there is no such suite, or the recordings cannot be written.
    """
    from tqdm import tqdm

    from app.sensors.simulator.suite import find_suite, make_twin

    twins = find_suite(name)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise HemislamError(f"The folder {folder} cannot be created: {error.strerror}; choose another one.") from None
    recordings = []
    for seed in seeds:
        for twin in twins:
            with tqdm(desc=f"{twin.scene}, seed {seed}", unit=" scans", leave=False, disable=None) as bar:

                def show(done: int, total: int, bar: "tqdm[None]" = bar) -> None:  # type: ignore[assignment]
                    bar.total = total
                    bar.update(done - bar.n)

                made = make_twin(twin, folder, seed=seed, short=short, every_block=every_block, progress=show)
            state = "made" if made.new else "exists already"
            typer.echo(f"{made.recording}: {made.distance_m:.1f} m walked, {state}")
            recordings.append(made.recording)
    return recordings
