"""A slice of the fuzzer: cases that once broke an invariant, and a few more of each kind."""

from collections.abc import Iterator

import pytest

from benchmarks.fuzz.__main__ import WORTH, Fuzzer, kept

NEW = 8
"""Cases of a kind, times its worth."""


@pytest.fixture(scope="module")
def fuzzer() -> Iterator[Fuzzer]:
    with Fuzzer() as made:
        yield made


@pytest.mark.parametrize("case", kept())
def test_what_once_broke_holds(fuzzer: Fuzzer, case: str) -> None:
    assert fuzzer.broken(case) == ""


@pytest.mark.parametrize("kind", WORTH)
def test_damaged_input_is_refused_in_a_sentence_or_taken(fuzzer: Fuzzer, kind: str) -> None:
    count = 2 if kind == "recordings" else NEW * WORTH[kind]
    broken = {seed: found for seed in range(count) if (found := fuzzer.broken(f"{kind}:{seed}"))}
    assert not broken
