"""The SLAM engine: headless and deterministic.

`engine` has the step of a frame: `imu`, `ground`, `voxel`, `local_map`, `iekf`. `types` has the values, `sections` the
parameters, `keyframes` what is kept on disk, `parallel` the threads that search planes. `loops/` corrects the map,
`kernels/` holds all numba code.
"""
