"""hemislam: an interactive LiDAR-inertial mapping workbench for hemispherical scanners."""

import os
from pathlib import Path

from app import kernel_cache

__version__ = "0.1.0"

# Before numpy is loaded. Our systems of equations are small: more threads would wait for each other, in loops that take
# the cores from the rest of the program.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

TEMPORARY_KERNEL_CACHE = kernel_cache.fall_back(os.environ, Path(__file__).parent)
