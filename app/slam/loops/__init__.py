"""Loops: places seen twice are recognised, verified, judged, and correct the map (paper 2.4).

`backend` is all of it: `detection` and `verification` find candidates, `support` compares them, and `graph` and
`solvers` correct the poses. `schedule` decides when results take effect, `edits` are the user's decisions.
"""
