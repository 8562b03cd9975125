"""The paper's suite of simulated recordings, made with a progress bar; for `simulate` and `evaluate`."""

from pathlib import Path

import typer

from app.slam.errors import HemislamError


def make_suite(
    name: str, folder: Path, seeds: list[int], *, short: bool = False, every_block: int | None = None
) -> list[Path]:
    """Make what is not there yet and return all recordings.

    Raises:
        HemislamError: there is no such suite, or the recordings can not be made.
    """
    from tqdm import tqdm

    from app.sensors.simulator.suite import find_suite, make_twin

    twins = find_suite(name)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise HemislamError(f"The folder {folder} can not be made: {error.strerror}; choose another one.") from None
    recordings = []
    for seed in seeds:
        for twin in twins:
            with tqdm(desc=f"{twin.scene}, seed {seed}", unit=" scans", leave=False, disable=None) as bar:

                def show(done: int, total: int, bar: "tqdm[None]" = bar) -> None:  # type: ignore[assignment]
                    bar.total = total
                    bar.update(done - bar.n)

                made = make_twin(twin, folder, seed=seed, short=short, every_block=every_block, progress=show)
            state = "made" if made.new else "there already"
            typer.echo(f"{made.recording}: {made.distance_m:.1f} m walked, {state}")
            recordings.append(made.recording)
    return recordings
