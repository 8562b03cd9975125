"""The SLAM engine: headless, deterministic, without threads or clocks of its own."""
