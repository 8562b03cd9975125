"""Where on Earth a map is: coordinate systems (`crs`), GNSS `fixes`, `control` points, and the resulting transform.

`align` fits a trajectory to fixes, `bend` lets fixes correct the pose graph, `reference` is the result.
"""
