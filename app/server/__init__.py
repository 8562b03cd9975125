"""The engine's process, what pages are sent of it, and the one public port.

`engine_process` runs a `controller` and a `player` there; `publisher` makes deltas, which `worker` and `fold` turn into
snapshots here. `protocol` declares commands and snapshots, `keeping` the commands for what a session keeps beside the
map. `web`, `access`, `bridge` and `api` are the port; `fork` runs two engines.
"""
