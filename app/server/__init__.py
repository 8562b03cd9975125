"""The engine's process, the snapshots that it sends to pages, and the only public port.

In the engine's process, `engine_process` runs a `controller` and a `player`, and `publisher` makes deltas. In the
server's process, `worker` and `fold` turn these into snapshots. `protocol` declares commands and snapshots; `keeping`
declares the commands for user data such as notes. `web`, `access`, `bridge` and `api` serve the public port; `fork`
runs two engines.
"""
