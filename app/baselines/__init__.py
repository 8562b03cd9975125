"""Other systems to compare with, fed like our engine: the paper's LOAM and LIOM, and odometries from PyPI (`peers`).

`systems` lists them.
"""
