"""Where results come from: the hash of the input, the machine, the memory used."""

import hashlib
import os
import platform
import resource
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

from app.slam.errors import HemislamError


def hash_input(recording: Path) -> str | None:
    """SHA-256 of a file, or of a folder's files in order of name; None if it cannot be read."""
    digest = hashlib.sha256()
    try:
        files = sorted(path for path in recording.rglob("*") if path.is_file()) if recording.is_dir() else [recording]
        for path in files:
            with path.open("rb") as file:
                while block := file.read(1 << 20):
                    digest.update(block)
    except OSError:
        return None
    return digest.hexdigest()


def sha256_of(recording: Path) -> str:
    """As `hash_input`. Raises HemislamError: it cannot be read."""
    if (digest := hash_input(recording)) is None:
        raise HemislamError(f"{recording} cannot be read; check its permissions.")
    return digest


def peak_memory_mb() -> float:
    """Peak resident memory of this process, MB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def describe_machine() -> dict[str, Any]:
    """The machine; timings mean nothing without it."""
    return {
        "system": platform.platform(),
        "processor": _processor_name(),
        "cores": cores(),
        "python": platform.python_version(),
        "numpy": version("numpy"),
        "numba": version("numba"),
    }


def _processor_name() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
