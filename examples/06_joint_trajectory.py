"""From an exported grasp to a joint trajectory at 250 Hz. It has the order and the stiffness of the
hand's driver.

hands/README.md tells order, zeros and stiffness for each shipped hand. Here it is Wonik's driver of
the Allegro hand.
"""

import json
import tempfile
from pathlib import Path

import numpy as np

from torchgrasp import ContactSpec, load_hand, load_object, plan_grasps
from torchgrasp.export import format_grasps

RATE = 250  # targets a second
ORDER = [f"joint_{k}" for k in range(16)]  # sixteen positions, those of the parked finger too
# N m/rad of the driver's position control; by how far targets lead the joints depends on it
STIFFNESS = 0.5

hand = load_hand("allegro")
grasps = plan_grasps(load_object("cylinder").view, hand, ContactSpec(table=0.0), starts=50)
# as `torchgrasp export GRASPS --force 3 --kp 0.5` writes it
file = Path(tempfile.mkdtemp()) / "grasps.json"
file.write_text(format_grasps(hand, grasps[:1], force=3.0, kp=STIFFNESS))

content = json.loads(file.read_text())  # from here on the file is enough
best = content["grasps"][0]
times = content["time"]
postures = sorted(times, key=times.get)  # pregrasp, grasp, squeeze
print("the arm brings the hand's root to", best["pose"], "along", best["approach"])
print("and stays off by", best["rise"])

knots = np.array([[best["joints"][posture][joint] for joint in ORDER] for posture in postures])
seconds = np.arange(round(times["squeeze"] * RATE) + 1) / RATE
targets = np.stack(
    [np.interp(seconds, [times[p] for p in postures], knot) for knot in knots.T], axis=1
)
# LEAP: motors stand at these angles + pi; Shadow: one motor moves J1 + J2

speed = np.abs(np.diff(targets, axis=0)).max(0) * RATE
slowest = min(hand.actuators[joint].velocity for joint in ORDER)
print(
    f"{len(targets)} targets in {seconds[-1]:.1f} s; the fastest joint moves at {speed.max():.1f} of {slowest} rad/s"
)
torque = max(abs(value) for value in best["torque"].values())
print(
    f"held by {torque:.2f} N m at most, by targets {np.abs(knots[2] - knots[1]).max():.2f} rad ahead of the joints"
)
np.savetxt(
    file.with_name("targets.csv"), targets, delimiter=",", header=",".join(ORDER), comments=""
)
