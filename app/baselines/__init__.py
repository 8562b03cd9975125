"""Other systems to compare with, with the same input as our engine: the paper's LOAM and LIOM, and odometry packages
from PyPI (`peers`).

`systems` lists them.
"""
