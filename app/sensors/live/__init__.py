"""Measurements as they happen: the sensor's own packets, captures of them, other robots, and what plays them out."""
