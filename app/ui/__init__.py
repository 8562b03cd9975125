"""The page: viser widgets that draw snapshots and enqueue commands."""
