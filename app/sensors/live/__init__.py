"""Live sensors: packets of LiDARs, IMU datagrams, Foxglove bridges, and captures of packets.

Packets become revolutions (`frames`) and scans (`decoder`). Receiving threads (`udp`, `foxglove`) put scans and samples
into the `intake`, from which the `source` hands out measurements. `feed` plays a recording as a live sensor.
"""
