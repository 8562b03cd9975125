"""Loops in the page: arches in the scene (`edges`), the `table` of candidates, the `inspector` of one, and `edits`.

`panel` puts them together.
"""
