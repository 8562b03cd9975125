"""What a recording alone shows about its sensors: mounting, clocks, biases and the errors of scan lines.

Nothing of `sensor.*` is read. Frames are those of `app.slam.types`; `world` is the frame of the LiDAR odometry: that of
the LiDAR at the end of the first scan.
"""
