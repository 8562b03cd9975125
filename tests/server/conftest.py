"""The engine's process is spawned anew and must find `server_fakes`, so its folder goes on the path."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
