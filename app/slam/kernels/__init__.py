"""All numba kernels: pure functions on plain arrays, each called through a documented wrapper.

Docstrings state shapes and types (f32, f64, i32, u8, ...), units, and which arrays are outputs. Parallel kernels
write each output once, or reduce over a fixed number of chunks that are then added in order, so that results do not
depend on the number of threads.
"""
