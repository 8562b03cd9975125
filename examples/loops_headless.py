"""Loops and the pose graph without a page: process a recording, reject its first loop, and compare both trajectories.

python examples/loops_headless.py sample_data/cloister.mcap
"""

import sys
from pathlib import Path

import numpy as np

from app.mapping.opening import open_session
from app.slam.loops.edits import Reject
from app.slam.loops.service import InlineLoops
from app.slam.loops.types import Verdict
from app.slam.params import Params

path = Path(sys.argv[1])
beside = path.with_suffix(".params.yaml")
params = Params().merged_yaml(beside.read_text()) if beside.exists() else Params()

session = open_session(path, params, loops=InlineLoops)
while session.advance() is not None:
    pass
found = session.loops.results()
for edge in found.edges:
    print(f"{edge.older} - {edge.newer}: {edge.verdict}, {edge.reason}")

accepted = [edge for edge in found.edges if edge.verdict is Verdict.ACCEPTED]
if accepted:
    before = found.frame.trajectory(session.log.odometry).positions
    first = accepted[0]
    session.edit_loops((Reject(first.older, first.newer),))
    edited = session.loops.results()
    after = edited.frame.trajectory(session.log.odometry).positions
    # 0 mm is usual: loops that already agree with the odometry move nothing (docs/decisions/019)
    moved = np.linalg.norm(after - before, axis=1).max()
    left = [edge for edge in edited.edges if edge.verdict is Verdict.ACCEPTED]
    still = any((edge.older, edge.newer) == (first.older, first.newer) for edge in left)
    print(f"{first.older} - {first.newer} is {'still' if still else 'no longer'} among the {len(left)} accepted loops")
    print(f"the trajectory moves by up to {1e3 * moved:.2f} mm")
    print(f"the graph has {sum(line.startswith('EDGE') for line in edited.g2o.splitlines())} factors")
session.close()
