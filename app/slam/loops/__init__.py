"""Loops: places seen twice are recognised, verified, judged, and straighten the map (paper 2.4)."""
