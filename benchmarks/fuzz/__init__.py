"""Damaged input of every kind: `python -m benchmarks.fuzz --seconds 60`.

Each case is determined by its kind and its seed. Cases that once broke an invariant are kept in `seeds.txt`, and the
tests repeat them every time.
"""
