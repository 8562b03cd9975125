"""What a recording alone shows about its sensors: mounting, clocks, biases and the errors of scan lines.

The fits use nothing of `sensor.*`; what is saved of the mounting is the mean of the fit and of what was given. Frames
are those of `app.slam.types`; `world` is the frame of the LiDAR odometry, that of the LiDAR at the end of the first
scan.
"""
