"""The engine's process, the snapshots that pages get from it, and the only public port.

In the engine's process, `engine_process` runs a `controller` and a `player`, and `publisher` makes deltas. In the
server's process, `worker` and `fold` turn these into snapshots. `protocol` declares commands and snapshots, `keeping`
the commands for what a session keeps beside the map. `web`, `access`, `bridge` and `api` form the port; `fork` runs two
engines.
"""
