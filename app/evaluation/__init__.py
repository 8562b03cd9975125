"""Measures the engine against truth and against itself: variants, errors, times, fineness, reports."""
