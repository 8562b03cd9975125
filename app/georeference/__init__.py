"""The place of a map on Earth: coordinate systems (`crs`), GNSS `fixes`, `control` points, and the resulting transform.

`align` fits a trajectory (`path`) to fixes in metres on the `ground`, and `bend` lets fixes correct the pose graph.
`reference` is the result.
"""
