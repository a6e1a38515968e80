"""A drag as text in the metadata of its grasps: one file holds both."""

import dataclasses
import functools
import json
import math
from pathlib import Path
from typing import Any

import torch

from torchgrasp.files import Field
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import is_rigid
from torchgrasp.geometry.frames import real
from torchgrasp.geometry.plane import Plane
from torchgrasp.planner.drag_plan import DRAG, DragPlan
from torchgrasp.values.planning import Grasps

KEY = "drag"
"""Entry of `Grasps.meta` that holds the drag."""


@checked
def with_drag(grasps: Grasps, drag: DragPlan) -> Grasps:
    """Return the grasps with a `drag` that comes before them, as JSON text in `meta["drag"]`.

    `Grasps.save` writes the text too, and `drag_of` reads the drag from it. Positions in the text
    are in the frame of the cloud. The keys of the text end with the units. `joints_rad` maps names
    of joints to positions, and `feet_m` names of pressing fingers to points. Raises `BadArgument`
    for a drag with another number of joints or fingers than the grasps.

    >>> from torchgrasp import ContactSpec, Plane, load_object, plan_edge_grasps
    >>> x = torch.tensor([1.0, 0, 0])
    >>> spec = ContactSpec(table=Plane.horizontal(0.0).ending(0.2 * x, x))
    >>> plan = plan_edge_grasps(load_object("cylinder"), "barrett", spec, starts=8)
    >>> plan.drag is None or drag_of(plan.grasps) == plan.drag
    True
    """
    joints, fingers = _names(grasps)
    if len(joints) != len(drag.joints) or len(fingers) != len(drag.presses):
        found = f"{len(drag.joints)} joints, {len(drag.presses)} fingers"
        raise BadArgument("drag", found, f"{len(joints)} and {len(fingers)}, as the grasps have")
    content = {
        "joints_rad": dict(zip(joints, drag.joints.tolist(), strict=True)),
        "obj_from_hand_m": drag.obj_from_hand.tolist(),
        "feet_m": {
            name: foot
            for name, foot, pressed in zip(
                fingers, drag.feet.tolist(), drag.presses.tolist(), strict=True
            )
            if pressed
        },
        "displacement_m": drag.displacement.tolist(),
        "force_n": drag.force,
        "table": _describe(drag.table),
        "edge": None if drag.table.edge is None else _describe(drag.table.edge),
    }
    return dataclasses.replace(grasps, meta={**grasps.meta, KEY: json.dumps(content)})


@checked
def drag_of(grasps: Grasps) -> DragPlan | None:
    """Return how the hand drags the object to the table's edge before it grasps the object there.

    The result is the `DragPlan` that `plan_edge_grasps` and `torchgrasp grasp --edge` store in
    `Grasps.meta`. It is None if the grasps need no drag. Its tensors are in float64. Raises
    `BadArgument` for a malformed drag.

    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> drag_of(load_shipped_grasp("jug", "allegro")) is None
    True
    """
    text = grasps.meta.get(KEY)
    if text is None:
        return None
    refuse = functools.partial(BadArgument, "grasps")
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise refuse(f"a drag that is no JSON: {error}", "the text of a drag") from error
    whole = Field(Path("meta"), KEY, content, refuse)
    fields = whole.entries(
        "joints_rad", "obj_from_hand_m", "feet_m", "displacement_m", "force_n", "table", "edge"
    )
    joints, fingers = _names(grasps)
    angles = fields["joints_rad"].entries(*joints)
    pose = real([row.numbers(4) for row in fields["obj_from_hand_m"].items(4)])
    if pose.shape != (4, 4) or not is_rigid(pose):
        raise fields["obj_from_hand_m"].wrong("a rigid transform of 4 x 4 numbers")
    feet = fields["feet_m"].entries()
    if not feet or not feet.keys() <= {*fingers}:
        raise fields["feet_m"].wrong(f"points of some of {', '.join(fingers)}")
    edge = fields["edge"]
    table = _read_plane(fields["table"])
    return DragPlan(
        joints=real([angles[name].number() for name in joints]),
        obj_from_hand=pose,
        presses=torch.tensor([name in feet for name in fingers]),
        feet=real([feet[name].numbers(3) if name in feet else [math.nan] * 3 for name in fingers]),
        displacement=real(fields["displacement_m"].numbers(3)),
        force=fields["force_n"].number(0.0, DRAG.most),
        table=table if edge.value is None else dataclasses.replace(table, edge=_read_plane(edge)),
    )


def _names(grasps: Grasps) -> tuple[list[str], list[str]]:
    """Return the names of the actuated joints and of the fingers of grasps."""
    joints, fingers = (
        grasps.meta.get(key, "").split(",") for key in ("joint_names", "finger_names")
    )
    return joints, fingers


def _describe(plane: Plane) -> dict[str, Any]:
    """Return the normal and the offset [m] of a plane, for JSON."""
    return {"normal": plane.normal.tolist(), "offset_m": plane.offset}


def _read_plane(field: Field) -> Plane:
    """Return the plane that `_describe` described."""
    numbers = field.entries("normal", "offset_m")
    return Plane(real(numbers["normal"].numbers(3)), numbers["offset_m"].number())
