"""The session: a feed of measurements, the engine, the loops, and the log of what came of them."""
