"""Damaged input of every kind: `python -m benchmarks.fuzz --seconds 60`.

Each case follows from its kind and its seed. Those that once broke an invariant are kept in `seeds.txt`; the tests try
them again each time.
"""
