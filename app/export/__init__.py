"""The result files of every run, and the map in other formats.

`results` declares all files; the other modules write one format each, from the points that `points` streams.
"""
