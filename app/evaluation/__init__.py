"""Measure the engine against truth and against itself: variants, errors, times, map sharpness, reports."""
