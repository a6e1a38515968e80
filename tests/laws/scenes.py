"""The laws of simulators: what a trial needs of a scene."""

import dataclasses
from collections.abc import Callable

import numpy as np
import torch

from torchgrasp.foundation.errors import BrokenLaw
from torchgrasp.geometry.frames import rigid, rotation_from_vector
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import load_hand
from torchgrasp.sim.scene_spec import SceneSpec
from torchgrasp.sim.simulated_scene import STILL, SimulatedScene

Open = Callable[[SceneSpec], SimulatedScene]
"""Opens a fresh scene, as `open_scene` and a class of scenes do."""

RADIUS = 0.03
HEIGHT = 0.12
FOOT = 0.2
MASS = 0.36
"""The object [m, kg]: a cylinder that stands on a table `FOOT` above the origin."""
STEPS = 200
"""Steps of a test, 0.4 s: SAPIEN takes 0.1 s for them."""
POSE = 1e-4
MOVED = 5e-4
"""Errors [m, and entries of rotations] of poses that are set, and of those that motors or forces
lead to.
"""


def check_scene(open_scene: Open, hand: Hand | None = None) -> None:
    """Check a simulator of your own: every call of `open_scene` returns a fresh `SimulatedScene` of
    a `SceneSpec`.

    The laws, by the name that an error gives them:

    * `joints`: `joint_names` are the movable joints of the URDF, which start where the
      specification says.
    * `kinematics`: root, fingertips and Jacobian are those of the hand, and nothing overlaps.
    * `rest`: an object on the table stays where it stands, and nothing is touched.
    * `rock`: a cylinder tipped by few degrees stands again on the table.
    * `fall`: without a table it falls by g t^2 / 2.
    * `pull`: a force at the mass centre of a weightless object moves it by F t^2 / (2 m) and turns
      it nowhere.
    * `slide`: an object on the table slides only under a force beyond friction; `displace` moves
      the object.
    * `drive`: joints go to the targets of their drives.
    * `lift`, `approach`: the mount moves the hand along the world's z axis, and along the approach.
    * `overlap`: a hand that begins inside the object is told so.
    * `touch`: a fingertip that sinks onto the object is told to touch.
    * `repeat`: the same commands in a fresh scene give the same bits.
    """
    hand = load_hand("barrett") if hand is None else hand
    law = _Laws(open_scene, _spec(hand), hand)
    law.check_start()
    law.check_object()
    law.check_slide()
    law.check_hand()
    law.check_repeat()


def _spec(hand: Hand) -> SceneSpec:
    """Return a hand in the middle of its range, half a metre above the object, in a general pose."""
    import trimesh

    mesh = trimesh.creation.cylinder(radius=RADIUS, height=HEIGHT)
    mesh.apply_translation([0, 0, FOOT + HEIGHT / 2])
    turn = rotation_from_vector(torch.tensor([0.3, -0.8, 1.1], dtype=torch.float64))
    pose = rigid(turn, torch.tensor([0.05, -0.1, 0.6 + HEIGHT], dtype=torch.float64)).numpy()
    middle = hand.expand(0.5 * (hand.lower + hand.upper))
    start = {name: float(value) for name, value in middle.items()}
    return SceneSpec(
        hand.urdf_path, pose, start, hand.actuators, hand.tips.links, mesh, [mesh.convex_hull], MASS
    )


@dataclasses.dataclass(frozen=True)
class _Laws:
    """The laws of one simulator, each of scenes of its own."""

    open_scene: Open
    spec: SceneSpec
    hand: Hand

    def scene(self, **changes: object) -> SimulatedScene:
        """Return a fresh scene of the specification but for some changes."""
        scene = self.open_scene(dataclasses.replace(self.spec, **changes))  # pyright: ignore[reportArgumentType]
        if not isinstance(scene, SimulatedScene):
            raise BrokenLaw("scene", type(scene).__name__, "a torchgrasp.sim.SimulatedScene")
        return scene

    def check_start(self) -> None:
        """Compare joints and kinematics with the hand's own."""
        scene = self.scene()
        hand = self.hand
        names = self.hand.tree.joint_names
        if sorted(scene.joint_names) != sorted(names):
            raise BrokenLaw("joints", str(scene.joint_names), f"each of {names}")
        start = np.array([self.spec.joints[name] for name in scene.joint_names])
        compare("joints", "positions", scene.joints(), start, POSE)
        if scene.penetration() != 0.0:
            raise BrokenLaw(
                "kinematics", f"a depth of {scene.penetration():.3g} m far from everything", "0"
            )
        joints = 0.5 * (hand.lower + hand.upper)
        pose = torch.from_numpy(self.spec.world_from_hand)
        compare("kinematics", "the root", scene.hand_pose(), pose.numpy(), POSE)
        compare(
            "kinematics",
            "tips",
            scene.tip_poses(),
            (pose @ hand.link_poses(joints)[hand.tips.index]).numpy(),
            POSE,
        )
        points = hand.fingertips(joints)[0] @ pose[:3, :3].T + pose[:3, 3]
        order = [names.index(name) for name in scene.joint_names]
        found = scene.jacobian(points.numpy()) @ hand.actuated.coupling[order].numpy()
        compare(
            "kinematics",
            "the Jacobian",
            found,
            (pose[:3, :3] @ hand.jacobian(joints)).numpy(),
            POSE,
        )
        inside = self.spec.world_from_hand.copy()
        inside[:3, 3] += self.spec.mesh.center_mass - points[0].numpy()
        if not self.scene(world_from_hand=inside, table=False).penetration() > 0.001:
            raise BrokenLaw(
                "overlap", "no depth of a fingertip amid the object", "more than 0.001 m"
            )

    def check_object(self) -> None:
        """Compare the object's motion with that of a rigid body."""
        scene = self.scene()
        for _ in range(STEPS):
            step = scene.step()
            if step.finger.any() or step.weight.any() or step.stray.any():
                raise BrokenLaw("rest", "contacts of a hand far from everything", "none")
        compare("rest", "the object on the table", scene.object_pose(), np.eye(4), POSE)
        rocking = self.scene()
        tip = np.array([0.0, 1.2 * MASS * self.spec.gravity * RADIUS, 0.0])
        for k in range(2 * STEPS):
            rocking.pull(STILL, tip if k < STEPS // 5 else STILL)
            rocking.step()
        compare(
            "rock",
            "the object on the table",
            rocking.object_pose()[:3, 2],
            np.array([0.0, 0.0, 1.0]),
            0.05,
        )
        falling = self.scene(table=False)
        for _ in range(STEPS):
            falling.step()
        time = STEPS * self.spec.timestep
        moved = np.eye(4)
        moved[2, 3] = (
            -0.5 * self.spec.gravity * time * (time + self.spec.timestep)
        )  # of implicit Euler steps
        compare("fall", "the object", falling.object_pose(), moved, 5e-3)
        pulled = self.scene(table=False, gravity=0.0)
        force = np.array([0.0, 0.2 * MASS, 0.0])
        pulled.pull(force)
        for _ in range(STEPS):
            pulled.step()
        moved = np.eye(4)
        moved[1, 3] = 0.5 * 0.2 * time * (time + self.spec.timestep)
        compare("pull", "the object", pulled.object_pose(), moved, MOVED)

    def check_slide(self) -> None:
        """Push the object along the table with forces just below and above friction."""
        for share, time in ((0.9, 0.0), (1.3, 0.4)):
            scene = self.scene(table_friction=0.2)
            weight = MASS * self.spec.gravity
            scene.displace(np.array([0.04, -0.02, 0.0]))
            top = np.array(
                [0.0, HEIGHT / 2 * share * 0.2 * weight, 0.0]
            )  # the force acts at the foot: nothing tips
            scene.pull(np.array([share * 0.2 * weight, 0.0, 0.0]), -top)
            for _ in range(STEPS):
                scene.step()
            moved = np.array(
                [0.04 + 0.5 * (share - 1) * 0.2 * self.spec.gravity * time**2, -0.02, 0.0]
            )
            compare(
                "slide",
                f"the object under {share:g} of friction",
                scene.object_pose()[:3, 3],
                moved,
                2e-3,
            )

    def check_hand(self) -> None:
        """Compare the hand's motion with what its motors were told."""
        scene = self.scene(approach=(0.0, 0.06, -0.08))
        scene.step()
        compare(
            "approach",
            "the hand at its start",
            scene.hand_pose()[:3, 3],
            self.place(0.0, -0.06, 0.08),
            MOVED,
        )
        middle = 0.5 * (self.hand.lower + self.hand.upper)
        index = self.hand.tree.joint_names
        targets = self.hand.expand_joints(middle + 0.1 * (self.hand.upper - self.hand.lower))
        targets = targets.numpy()[[index.index(name) for name in scene.joint_names]]
        scene.drive(targets)
        for k in range(3 * STEPS):
            done = min(1.0, (k + 1) / STEPS)
            scene.approach(0.1 * (1 - done))
            scene.lift(0.05 * done)
            scene.step()
        compare(
            "lift",
            "the hand at its end",
            scene.hand_pose()[:3, 3],
            self.place(0.0, 0.0, 0.05),
            2 * MOVED,
        )
        compare("drive", "joints", scene.joints(), targets, 5e-3)

    def check_repeat(self) -> None:
        """Compare two runs of the same commands, bit by bit."""
        runs = [b"".join(self.run()) for _ in range(2)]
        if runs[0] != runs[1]:
            raise BrokenLaw(
                "repeat", "other bits in a fresh scene", "the same poses, joints and contacts"
            )

    def run(self) -> list[bytes]:
        """Let the lowest fingertip sink onto the object; return all that happens."""
        near = self.spec.world_from_hand.copy()
        points, _ = self.hand.fingertips(0.5 * (self.hand.lower + self.hand.upper))
        tips = points.numpy() @ near[:3, :3].T
        near[:3, 3] = self.spec.mesh.center_mass - tips[tips[:, 2].argmin()]
        near[2, 3] += HEIGHT / 2 + 0.02
        scene = self.scene(world_from_hand=near)
        told = []
        touched = False
        for k in range(STEPS):
            scene.lift(-0.04 * k / STEPS)
            step = scene.step()
            touched |= bool(step.finger.any() or step.stray.any())
            state = (
                scene.object_pose(),
                scene.joints(),
                scene.tip_poses(),
                step.impulse,
                step.force,
                step.stray,
            )
            told.append(b"".join(np.ascontiguousarray(x).tobytes() for x in state))
        if not touched:
            raise BrokenLaw(
                "touch",
                "no contact of a hand that sinks onto the object",
                "one of a finger or a link",
            )
        return told

    def place(self, *offset: float) -> np.ndarray:
        return self.spec.world_from_hand[:3, 3] + offset


def compare(law: str, what: str, found: np.ndarray, wanted: np.ndarray, most: float) -> None:
    """Raise `BrokenLaw` for an array of another shape, or one that is off by more than `most`."""
    if np.shape(found) != np.shape(wanted):
        raise BrokenLaw(law, f"{what} of shape {np.shape(found)}", f"shape {np.shape(wanted)}")
    error = float(np.abs(found - wanted).max())
    if not error <= most:
        raise BrokenLaw(law, f"{what} off by {error:.3g}", f"at most {most:g}")
