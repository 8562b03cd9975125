"""All numba kernels: pure functions on plain arrays, each called through a documented wrapper.

Docstrings state shapes and types (f32, f64, i32, u8, ...), units, and which arrays are outputs. Each runs on one
thread, so sums have one order and results the same bytes everywhere.
"""
