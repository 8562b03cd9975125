"""The session: a feed of measurements, the engine, the loops, and the log of their results.

`session.py` drives one frame after the other, `feed.py` defines a source, `opening.py` and `live.py` open one.
`session_file.py` keeps a session so that it can be repeated, and with it what the user adds to the map (`kept.py`).
`serve`, `run`, `replay` and `evaluate` all use this.
"""
