"""hemislam: an interactive LiDAR-inertial mapping workbench for hemispherical scanners."""

import os
from pathlib import Path

from app import kernel_cache

__version__ = "0.1.0"

# numba and OpenMP read these once, when they are first imported. The workqueue layer aborts a
# process in which two threads run parallel kernels, and a spinning OpenMP pool makes every other
# thread of the machine wait, so both are settled here, before anything else is imported.
os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp tbb workqueue")
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
TEMPORARY_KERNEL_CACHE = kernel_cache.fall_back(os.environ, Path(__file__).parent)
