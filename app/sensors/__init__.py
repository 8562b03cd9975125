"""Where measurements come from: recordings, packets, live sources and the simulator; and the recording doctor.

A file is opened (`source`). Its first messages settle how it is read (`probe`, `layout`, `timing`, `rings`, `azimuth`).
Its scans are paired with the samples of other sensors by time (`recording`, `sequencer`). `cloud_types` is the table of
point-cloud message types, `presets` that of devices. `live` receives from sensors, `simulator` makes recordings.
"""
