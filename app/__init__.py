"""hemislam: an interactive LiDAR-inertial mapping workbench for hemispherical scanners."""

import os
from pathlib import Path

from app import kernel_cache

__version__ = "0.1.0"

TEMPORARY_KERNEL_CACHE = kernel_cache.fall_back(os.environ, Path(__file__).parent)
