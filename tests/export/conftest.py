"""Tests of exports share the small map of test_results.py."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
