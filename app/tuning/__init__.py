"""Search for the parameters that fit a sensor and a place: what may vary, what is wanted, and the trials."""
