"""The session: a feed of measurements, the engine, the loops, and the log of what came of them.

`session.py` drives one frame after the other, `feed.py` says what a source is, `opening.py` and `live.py` open one.
`session_file.py` keeps a session so that it can be repeated, with `kept.py`, what the user makes beside the map.
`serve`, `run`, `replay` and `evaluate` all use this.
"""
