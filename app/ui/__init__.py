"""The page: panels, the scene in space, and the drawing thread that brings both up to the newest snapshot.

`workbench` puts the page together. A panel draws snapshots and sends commands; it never waits for the engine.
HTML comes from `templates`; everything that relies on viser's page itself is in `viser_adapter`.
"""
