"""How long things take on this machine. `make bench` runs all; nothing here passes or fails."""
