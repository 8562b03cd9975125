"""Measurements of times on this machine. `make bench` runs all of them; nothing here passes or fails."""
