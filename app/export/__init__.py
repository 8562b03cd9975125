"""What a session leaves behind: the result files of every run, and the map in the formats of others."""
