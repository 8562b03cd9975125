"""Loops in the page: arches in the scene, the table of candidates, everything about one of them, and editing them."""
