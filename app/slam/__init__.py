"""The SLAM engine: headless, deterministic, without threads or clocks of its own.

`engine` has the step of a frame: `imu`, `ground`, `voxel`, `local_map`, `iekf`. `types` has the values, `sections` the
parameters, `keyframes` what is kept on disk. `loops/` corrects the map, `kernels/` holds all numba code.
"""
