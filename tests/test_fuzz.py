"""A part of the fuzzer: cases that once broke an invariant, and the first few cases of each kind."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_damaged_input_is_refused_in_a_sentence_or_taken() -> None:
    """In a process of its own: the fuzzer forks, which the threads of kernels that ran before would not survive."""
    command = [sys.executable, "-m", "benchmarks.fuzz", "--kept"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert int(done.stdout.split()[-2]) > 60
