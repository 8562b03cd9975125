"""Hypothesis for the engine's tests: the same examples on every run, and no verdict by the clock."""

from hypothesis import settings

settings.register_profile("hemislam", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("hemislam")
