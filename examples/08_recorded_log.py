"""A controller fed from a recorded log: the same commands to the bit, even if it is stopped, saved and set up anew.

The log comes from a simulated trial here (it needs the extra `sim`); on a robot, call `recorder.add` at every tick.
"""

import tempfile
from pathlib import Path

import torch

from torchgrasp import ContactSpec, TrialSpec, load_hand, load_object, plan_grasps
from torchgrasp.control import ControlRecorder, GraspController, load_control_log, load_controller_state
from torchgrasp.evaluation import GraspTrial, TrialDriver

hand, jug = load_hand("allegro"), load_object("jug")
grasp = plan_grasps(jug.view, hand, ContactSpec(table=0.0), starts=50)[0]
driver = TrialDriver(GraspTrial(hand, grasp, jug.mesh, parts=jug.parts), TrialSpec(approach=0.0))

run, recorder, seen = driver.open(), ControlRecorder(), None
for _ in run.close():  # a tick after the other: what was seen before it has led to the targets
    if seen is not None:
        recorder.add(seen, run.robot.period, run.controller.targets)
    seen = run.observation
with tempfile.TemporaryDirectory() as folder:
    recorder.log().save(Path(folder) / "closing.safetensors")
    log = load_control_log(Path(folder) / "closing.safetensors")
    print(f"recorded {len(log)} ticks, {float(log.period.sum()):.2f} s")

    controller = GraspController(driver.reference)
    for k, (observation, period, targets) in enumerate(log.ticks()):
        if k == len(log) // 2:  # the program stops here, and another one goes on
            controller.state().save(Path(folder) / "state.safetensors")
            controller = GraspController(driver.reference)
            controller.restore(load_controller_state(Path(folder) / "state.safetensors"))
        assert torch.equal(controller.step(observation, period).joints, targets.joints)
print(f"the log gives the same commands again, and the hand is closed: {controller.closed}")
