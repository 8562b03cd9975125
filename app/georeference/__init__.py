"""Where on Earth a map is: coordinate systems, GNSS fixes, control points, and the transform that they give."""
