"""What a recording alone shows about its sensors: mounting, clocks, biases and the errors of scan lines.

The fits do not use `sensor.*`; the saved mounting is the mean of the fit and of the given one. Frames are those of
`app.slam.types`; `world` is the frame of the LiDAR odometry: the LiDAR's frame at the end of the first scan.
"""
