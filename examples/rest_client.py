"""Control the workbench over REST: play to a frame, change a parameter, save the trajectory.

hemislam serve sample_data/cloister.mcap --paused --no-browser
python examples/rest_client.py http://127.0.0.1:8080
"""

import sys
import time

import httpx

url, *token = sys.argv[1:]
headers = {"Authorization": f"Bearer {token[0]}"} if token else {}

with httpx.Client(base_url=url, headers=headers, timeout=60) as client:

    def wait_for_frame(frame: int) -> None:
        """Wait until the session has reached this frame."""
        deadline = time.monotonic() + 120
        while client.get("/api/state").raise_for_status().json()["transport"]["frame"] != frame:
            if time.monotonic() > deadline:
                raise SystemExit(f"Frame {frame} was not reached within two minutes.")
            time.sleep(0.1)

    client.post("/api/transport", json={"action": "seek", "frame": 20}).raise_for_status()
    wait_for_frame(20)
    answer = client.patch("/api/params", json={"ground": {"alpha": 30}}).raise_for_status()
    print("alpha is now", answer.json()["ground"]["alpha"], "degrees")
    client.post("/api/transport", json={"action": "step", "frames": 1}).raise_for_status()
    wait_for_frame(21)
    trajectory = client.get("/api/export/trajectory.tum").raise_for_status().text
    print(f"the trajectory has {len(trajectory.splitlines())} poses; the last one is\n{trajectory.splitlines()[-1]}")
    wrong = client.patch("/api/params", json={"ground": {"alpha": 300}})
    print(wrong.status_code, wrong.json()["detail"])
