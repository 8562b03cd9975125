"""Loops in the page: arches in the scene (`edges`), the `table` of candidates, the `inspector` of a loop, and `edits`.

`panel` combines them.
"""
