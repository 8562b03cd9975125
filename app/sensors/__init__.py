"""Where measurements come from: recordings, the simulator, and the sequencer that pairs them."""
