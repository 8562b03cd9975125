"""Shared by all tests: settings, the recordings beside the project, and libraries that a bare machine may lack."""

import fcntl
import gc
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

# Containers often set it. Each process that the tests start would then compile the program anew, and each worker the
# tests.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

import pytest
from hypothesis import settings

from app.child import fork_context
from app.slam.errors import HemislamError

sys.dont_write_bytecode = False  # of this process, as above
gc.disable()  # until all tests are imported and collected

# The same examples on every run, and no verdict by the clock.
settings.register_profile("hemislam", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("hemislam")


COMPILE = """
from app.slam.loops.service import warm_up
from app.slam.warmup import compile_kernels
compile_kernels()
warm_up()
"""
compiling = pytest.StashKey[subprocess.Popen[bytes]]()


def pytest_configure(config: pytest.Config) -> None:
    # Not in pyproject.toml, since naming it imports numba, which must come after what `app` settles for it.
    config.addinivalue_line("filterwarnings", "error::numba.core.errors.NumbaWarning")
    if not hasattr(config, "workerinput") and config.getoption("numprocesses", None):
        config.stash[compiling] = subprocess.Popen([sys.executable, "-c", COMPILE], cwd=config.rootpath)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_node_collection_finished(node: Any) -> None:
    """Tests begin once the kernels are compiled: else the workers would do it at the same time, each for itself."""
    node.config.stash[compiling].wait()


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """One worker after the other: the first leaves its bytecode to the others, which else would all make it."""
    with Path(__file__).open("rb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        return (yield)


def pytest_collection_finish() -> None:
    """What is imported and collected stays: looking for garbage in it took a fifth of the time of the page's tests."""
    gc.collect()
    gc.freeze()
    gc.enable()
    gc.set_threshold(20_000, 20, 20)


@pytest.fixture(scope="session", autouse=True)
def _fork_server() -> None:
    """A fork server with every module that forks need; else it has those of the first fork, and other forks import."""
    fork_context("tests.forked")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The recordings beside the project. A checkout without them skips the test by name."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("needs the recordings in ../shared/data")
    return folder


def _skipped_without_open3d() -> Iterator[None]:
    """open3d needs libraries that a bare machine lacks, and only the simulator needs open3d. CI has them.

    Where a command or another process simulates, its message is part of a failed assertion.
    """
    try:
        return (yield)
    except (HemislamError, AssertionError) as error:
        if "needs open3d" in str(error) and not os.environ.get("CI"):
            pytest.skip("needs open3d, which needs libusb-1.0-0, libegl1 and libgl1")
        raise


pytest_runtest_setup = pytest.hookimpl(wrapper=True)(_skipped_without_open3d)
pytest_runtest_call = pytest.hookimpl(wrapper=True)(_skipped_without_open3d)
