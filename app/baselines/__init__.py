"""Other systems, fed as our engine is, to be compared with it: the paper's LOAM and LIOM, and odometries from PyPI."""
