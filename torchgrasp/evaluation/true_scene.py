"""The simulated scene of a trial: the true object and its table, and the hand before them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from torchgrasp.evaluation.frame import moved_mesh, rounded_table
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.geometry.frames import inverse
from torchgrasp.geometry.plane import Plane
from torchgrasp.hand.drives import stiff_drives
from torchgrasp.hand.hand import Hand
from torchgrasp.sim.convex_parts import read_solid
from torchgrasp.sim.scene_spec import Body, SceneSpec, edge_of
from torchgrasp.values.distribution import Distribution
from torchgrasp.values.specs import TrialSpec


def true_scene(
    spec: TrialSpec,
    hand: Hand,
    world_from_hand: Float[Tensor, "4 4"],
    joints: Float[Tensor, " h"],
    body: Body,
    **others: Any,
) -> SceneSpec:
    """Return the parameters of the simulated scene in which a trial with the parameters `spec`
    begins.

    `world_from_hand` (4, 4) [m] is the pose of the hand's root link in the simulator's frame.
    `joints` (h,) [rad or m] are its h actuated joints, and `body` is the object. `others` are
    further fields of `SceneSpec`.
    """
    return SceneSpec(
        urdf_path=hand.urdf_path,
        world_from_hand=world_from_hand.numpy(),
        joints=joints_by_name(hand, joints),
        drives=stiff_drives(hand, spec.kp),
        tip_links=tuple(hand.tips.links),
        mesh=body.mesh,
        parts=list(body.parts),
        mass=body.mass,
        friction=Distribution.of(spec.friction).mean,
        table_friction=spec.table_friction,
        gravity=spec.gravity,
        timestep=spec.timestep,
        patch=spec.patch,
        self_pairs=hand.self_pairs if spec.self_collision else (),
        **others,
    )


def true_body(
    spec: TrialSpec,
    mesh: "trimesh.Trimesh | Path | str",
    parts: "Sequence[trimesh.Trimesh] | None",
    mass: float | None = None,
    obj_from_world: Float[Tensor, "4 4"] | None = None,
) -> Body:
    """Return a closed mesh [m] as a body in the simulator's frame, with its convex parts and its
    mass [kg].

    `parts` of None are computed (`convex_parts`). A `mass` of None means that `spec` gives the
    mass. It is then the mean of a `Distribution`, or follows from `spec.density`. `obj_from_world`
    (4, 4) [m] is the pose of the simulator's frame in the frame of the mesh. None means that both
    frames are the same.
    """
    mesh, parts = read_solid(mesh, parts)
    density = spec.density
    if mass is None:
        mass = Distribution.of(spec.mass).mean if density is None else density * float(mesh.volume)
    if obj_from_world is not None:
        mesh, *parts = (moved_mesh(solid, obj_from_world) for solid in (mesh, *parts))
    return Body(mesh, parts, mass)


def edge_in_world(
    table: Plane, obj_from_world: Float[Tensor, "4 4"]
) -> tuple[float, float, float] | None:
    """Return the edge where a `table` ends as (x, y, offset) in the simulator's frame; None without
    an edge.

    (x, y) is a horizontal unit vector that points off the table, and `offset` [m] the edge's
    position along it. `obj_from_world` (4, 4) [m] is the pose of the simulator's frame in the frame
    of the `table`.
    """
    return edge_of(rounded_table(table.moved(inverse(obj_from_world))))


def joints_by_name(hand: Hand, joints: Float[Tensor, " h"]) -> dict[str, float]:
    """Return the positions [rad or m] of all movable joints of the URDF by name.

    `joints` (h,) [rad or m] are the positions of the h actuated joints.
    """
    return {name: float(q) for name, q in hand.expand(joints).items()}
