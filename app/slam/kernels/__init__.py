"""Every numba kernel: pure functions on bare arrays, each behind a documented wrapper elsewhere.

Parallel kernels write each output once or reduce over a fixed number of chunks that are then added
in order, so that a result never depends on the number of threads.
"""
