"""Run by test_play.py with Newton and OpenUSD: plays folders for Newton, checks the scene.usda of
another one, plays it, and prints results.
"""

import json
import math
import runpy
import sys
from pathlib import Path

import newton
import numpy as np
import warp
from pxr import Usd, UsdPhysics

warp.config.quiet = True
folder, *scenes = map(Path, sys.argv[1:])
sys.argv[1:] = ["0"]
for scene in scenes:
    names = runpy.run_path(str(scene / "play.py"), run_name="__main__")
iterations = names["solver"].mj_model.opt.noslip_iterations
play = json.loads((folder / "play.json").read_text())
stage = Usd.Stage.Open(str(folder / "scene.usda"))
parsed = UsdPhysics.LoadUsdPhysicsFromRange(stage, ["/"])
valid = all(one.isValid for _, some in parsed.values() for one in some)
joints = {}
for name in play["drives"]:
    prim = stage.GetPrimAtPath(f"/World/hand/{name}")
    turns = prim.IsA(UsdPhysics.RevoluteJoint)
    drive = UsdPhysics.DriveAPI.Get(prim, "angular" if turns else "linear")
    unit = math.degrees(1.0) if turns else 1.0
    stiffness = drive.GetStiffnessAttr().Get() * unit
    damping = drive.GetDampingAttr().Get() * unit
    joints[name] = {"kp": stiffness, "kd": damping, "effort": drive.GetMaxForceAttr().Get()}
runpy.run_path(str(folder / "play.py"), run_name="__main__")

builder = newton.ModelBuilder()
newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
builder.add_usd(str(folder / "scene.usda"))
label = {name.split("/")[-1]: k for k, name in enumerate(builder.joint_label)}
body = next(k for k, name in enumerate(builder.body_label) if name.endswith("object"))
times = np.array(list(play["times"].values()))
names = list(play["drives"])
step = play["timestep"]
targets = np.array([[x[name] for name in names] for x in play["grasps"][0]["targets"].values()])
places = [builder.joint_q_start[label[name]] for name in names]
for place, position in zip(places, targets[0], strict=True):
    builder.joint_q[place] = builder.joint_target_q[place] = position
model = builder.finalize(device="cpu")
now = model.state()
control = model.control()
newton.eval_fk(model, model.joint_q, model.joint_qd, now)
solver = newton.solvers.SolverMuJoCo(model, use_mujoco_cpu=True, cone="elliptic", impratio=10.0)
wanted = control.joint_target_q.numpy()
centre = play["object"]["centre"]
for time in np.arange(0.0, times[-1], step):
    k = np.searchsorted(times[1:-1], time, side="right")
    share = (time - times[k]) / (times[k + 1] - times[k])
    wanted[places] = targets[k] + share**2 * (3 - 2 * share) * (targets[k + 1] - targets[k])
    control.joint_target_q.assign(wanted)
    solver.step(now, now, control, None, step)
end = warp.transform_point(warp.transform(*now.body_q.numpy()[body].tolist()), warp.vec3(*centre))
print(
    json.dumps(
        {
            "valid": valid,
            "mass": builder.body_mass[body],
            "joints": joints,
            "rise": end[2] - centre[2],
            "iterations": iterations,
        }
    )
)
