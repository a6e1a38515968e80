"""The same verdict on every planner's grasps: contacts, collision and closure on the true mesh."""

import dataclasses
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

from benchmarks.ground_truth import nearest_on_mesh
from torchgrasp import Contacts, ContactSpec, Grasps, Hand, Status, certify, load_hand
from torchgrasp.evaluation.touch import TOUCH
from torchgrasp.export import grasps_from_joints
from torchgrasp.export.foreign import MOST_GRASPS, POSE_NUMBERS, read_poses
from torchgrasp.files import Field, read_json
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import apply, rigid
from torchgrasp.geometry.linalg import norm
from torchgrasp.geometry.signed_distance import field_from_surface
from torchgrasp.ik.candidates import measure_errors
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.configuration import Configuration


@dataclasses.dataclass(frozen=True)
class JudgeNumbers:
    """Parameters of the verdict."""

    gap: float = TOUCH.limit
    """Greatest distance [m] of a fingertip from the true surface."""
    limits: float = 0.01
    """Joints so far [rad] beyond a limit are put at it: FRoGGeR's tolerance."""
    same_tip: float = 0.001
    """Greatest distance [m] of told fingertips from those of our hand with the told joints."""
    inside: float = 1e-4
    """Distance [m] of a tip's centre from the surface at which the face's normal counts."""
    std: float = 0.001
    """Standard deviation [m] of the surface that the trial's controller is told, the same for all."""
    far: float = 10.0
    """Largest coordinate [m] and joint [rad] of an answer."""
    longest: float = 1e6
    """Most seconds and starts of an answer."""


NUMBERS = JudgeNumbers()


class Answer(NamedTuple):
    """What a planner found for an object.

    Attributes:
        hand: the hand with the fingers that grasp.
        joints: (g, h) [rad].
        obj_from_hand: poses (g, 4, 4) [m].
        tried: number of starts.
        seconds: CPU seconds of the search.
        sees: what the planner was given.
        settings: in one sentence.
        versions: of its packages, as text.
        told: what it measured by its own protocol, instead of grasps.
    """

    hand: Hand
    joints: Float[Tensor, "g h"]
    obj_from_hand: Float[Tensor, "g 4 4"]
    tried: int = 0
    seconds: float = 0.0
    sees: str = ""
    settings: str = ""
    versions: str = ""
    told: str = ""


class Judged(NamedTuple):
    """The grasps that pass, with their contacts on the true surface, and the number of each status."""

    grasps: Grasps
    counts: dict[str, int]


def read_answer(path: Path) -> Answer:
    """Return a planner's answer, from its file.

    Raises `BadArgument` in one sentence for a malformed answer, and for told fingertips that are
    not those of our hand with the told joints.
    """

    def refuse(found: str, allowed: str) -> BadArgument:
        return BadArgument("answer", found, allowed)

    fields = read_json(path, refuse, "a planner's answer").entries("versions")
    versions = fields["versions"].entries()
    said = ", ".join(f"{name} {version.text()}" for name, version in versions.items())
    if "told" in fields:
        hand = load_hand("allegro")
        none = torch.zeros(0, 4, 4, dtype=torch.float64)
        return Answer(hand, none[:, 0, : hand.dof], none, told=fields["told"].text(), versions=said)
    names = ("fingers", "sees", "settings", "tried", "seconds", "joint_names", "grasps")
    for name in names:
        if name not in fields:
            raise refuse(f"{path}: no {name}", ", ".join(names))
    option = fields["fingers"].text()
    if option not in ("default", "four"):
        raise fields["fingers"].wrong("'default' or 'four'")
    hand = load_hand("allegro", option)
    order = [name.text() for name in fields["joint_names"].items()]
    if missing := [name for name in hand.joint_names if name not in order]:
        raise fields["joint_names"].wrong(f"a list with {missing[0]}")
    columns = [order.index(name) for name in hand.joint_names]
    joints = list[list[float]]()
    poses = list[Tensor]()
    for grasp in fields["grasps"].items(MOST_GRASPS):
        content = grasp.entries("joints")
        values = content["joints"].numbers(len(order), -NUMBERS.far, NUMBERS.far)
        joints.append([values[k] for k in columns])
        poses.append(_read_pose(hand, joints[-1], grasp))
    known = torch.tensor(joints, dtype=torch.float64).reshape(-1, hand.dof)
    placed = torch.stack(poses) if poses else torch.zeros(0, 4, 4, dtype=torch.float64)
    return Answer(
        hand,
        known,
        placed,
        fields["tried"].whole(0, int(NUMBERS.longest)),
        fields["seconds"].number(0.0, NUMBERS.longest),
        fields["sees"].text(),
        fields["settings"].text(),
        said,
    )


def _read_pose(hand: Hand, joints: list[float], grasp: Field) -> Float[Tensor, "4 4"]:
    """Return the pose [m] of our root link: told, or from the told centres of fingertips."""
    content = grasp.entries()
    if "pose" in content:
        pose = content["pose"].numbers(POSE_NUMBERS, -NUMBERS.far, NUMBERS.far)
        return read_poses(torch.tensor([pose]).double().numpy(), "wxyz")[0]
    if "tips" not in content:
        raise grasp.wrong("an object with 'pose' or 'tips'")
    rows = [x.numbers(3, -NUMBERS.far, NUMBERS.far) for x in content["tips"].items()]
    if len(rows) != len(hand.tips):
        raise content["tips"].wrong(f"{len(hand.tips)} fingertips")
    there = torch.tensor(rows, dtype=torch.float64)
    here = hand.tip_centres(torch.tensor(joints, dtype=torch.float64))
    pose = fit_pose(here, there)
    apart = float(norm(apply(pose, here) - there).max())
    if not apart <= NUMBERS.same_tip:
        raise content["tips"].wrong(f"tips of our hand; {1000 * apart:.1f} mm off")
    return pose


def fit_pose(here: Float[Tensor, "n 3"], there: Float[Tensor, "n 3"]) -> Float[Tensor, "4 4"]:
    """Return the rigid transform that moves points nearest to others, by least squares."""
    middle = here.mean(0)
    target = there.mean(0)
    u, _, v = torch.linalg.svd((there - target).T @ (here - middle))
    turned = torch.ones(3, dtype=here.dtype)
    turned[2] = torch.linalg.det(u @ v)
    rotation = u @ torch.diag(turned) @ v
    return rigid(rotation, target - rotation @ middle)


def judge(answer: Answer, mesh: "trimesh.Trimesh", friction: float) -> Judged:
    """Return the grasps of an answer that pass our checks on the true mesh [m].

    * Joints are within their limits.
    * Each fingertip is within 3 mm of the surface, at most 2 mm in it, and touches with its pad.
    * No other link is in the object, and no link in another.
    * The contacts have force closure at the given friction.
    """
    hand = answer.hand
    beyond = torch.maximum(hand.lower - answer.joints, answer.joints - hand.upper).amax(-1)
    inside = answer.joints.clamp(hand.lower, hand.upper)
    spec = ContactSpec(friction, friction_margin=1.0, fingertips=len(hand.tips))
    grasps = grasps_from_joints(hand, inside, answer.obj_from_hand, spec=spec)
    if not len(grasps):
        return Judged(grasps, {})
    contacts = touch(hand, grasps, mesh)
    certificate = certify(contacts, spec)
    vertices = torch.tensor(mesh.vertices, dtype=torch.float64)
    world = CollisionWorld(field_from_surface(vertices, torch.tensor(mesh.faces)))
    configuration = Configuration(inside, answer.obj_from_hand)
    status = measure_errors(
        hand, configuration, contacts, world, tolerance=NUMBERS.gap
    ).status.clone()
    status[beyond > NUMBERS.limits] = int(Status.JOINT_LIMITS)
    status[(status == Status.OK) & ~certificate.closed] = int(Status.NOT_CLOSED)
    grasps = dataclasses.replace(grasps, contacts=contacts, certificate=certificate, status=status)
    counts = Counter(Status(code).name for code in status.tolist())
    return Judged(grasps[status == Status.OK], dict(counts.most_common()))


def touch(hand: Hand, grasps: Grasps, mesh: "trimesh.Trimesh") -> Contacts:
    """Return the points of the true surface nearest to the fingertips, with outward normals."""
    centres = apply(grasps.obj_from_hand, hand.tip_centres(grasps.joints)).reshape(-1, 3)
    feet, normals = nearest_on_mesh(mesh, centres)
    away = centres - feet
    distance = norm(away)
    outward = torch.sign((away * normals).sum(-1))[:, None]
    near = (distance < NUMBERS.inside)[:, None]
    directions = torch.where(near, normals, outward * away / distance[:, None])
    shape = (len(grasps), len(hand.tips), 3)
    std = torch.full(shape[:2], NUMBERS.std, dtype=torch.float64)
    return Contacts(feet.reshape(shape), directions.reshape(shape), std_m=std)
