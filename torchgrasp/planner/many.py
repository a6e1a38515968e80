"""Many clouds in one call: one after the other, or on several processes."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchgrasp.base import named_tensors
from torchgrasp.errors import BadArgument, GraspError, MissingExtra
from torchgrasp.files import temporary_folder
from torchgrasp.geometry.plane import Plane
from torchgrasp.hand.hand import Hand, HandSource
from torchgrasp.hand.load import load_hand
from torchgrasp.jobs import run_tasks
from torchgrasp.planner.chain import plan_request
from torchgrasp.planner.fingers import finger_sets
from torchgrasp.planner.task import Request
from torchgrasp.specs import ContactSpec
from torchgrasp.values import Certificate, Contacts, Grasps, PointCloud, load_grasps

LIMIT = 3600.0
"""Wall time [s] after which a worker's cloud is given up: hundreds of times the usual."""


def plan_many(clouds: Sequence[PointCloud], workers: int, given: dict[str, Any]) -> list[Grasps]:
    """Plan for each cloud, on its device; the result of each is that of `plan_grasps` alone.

    A cloud that `plan_grasps` refuses costs no other its grasps: its own are none, and `meta["refused"]` says why.

    Args:
        clouds: of one object each.
        workers: processes of one thread each; 0: this one.
        given: the other arguments of `Request`, for all clouds.

    Raises:
        BadArgument: an argument that is wrong for all, one that is of a single cloud (`shape`, `observer`,
            `reachable`), or a row that is no cloud.
        MissingExtra: pebble is not installed, for workers.
    """
    for name in ("shape", "observer", "reachable"):
        if given.get(name) is not None:
            raise BadArgument(name, "one beside many clouds", "None")
    for k, cloud in enumerate(clouds):
        if not isinstance(cloud, PointCloud):
            raise BadArgument(f"cloud[{k}]", type(cloud).__name__, "a PointCloud")
        request = Request(cloud, **given)
        finger_sets(request.hand, request.fingers, request.mode)
    if not workers:
        planned = (_plan_or_refuse(Request(cloud, **given)) for cloud in clouds)
        return [grasps.to(cloud.points.device) for cloud, grasps in zip(clouds, planned, strict=True)]
    hand, spec = given["hand"], given.get("spec")
    source = HandSource(hand.source.option, hand.source.urdf_path, hand.source.sha256)
    rest = {name: value for name, value in given.items() if name not in ("hand", "spec")}
    with temporary_folder() as folder:
        files = [folder / f"{k}.safetensors" for k in range(len(clouds))]
        sent = [(_arrays(cloud), str(cloud.points.device)) for cloud in clouds]
        tasks = [(*cloud, source, _plain(spec), rest, file) for cloud, file in zip(sent, files, strict=True)]
        ended = list(run_tasks(_plan_to_file, tasks, workers, LIMIT))
        found = (
            load_grasps(file) if end is None else refused(Request(cloud, **given), end.sentence)
            for cloud, file, end in zip(clouds, files, ended, strict=True)
        )
        return [grasps.to(cloud.points.device) for cloud, grasps in zip(clouds, found, strict=True)]


def refused(request: Request, reason: str) -> Grasps:
    """Return no grasps, with the reason in `meta`."""
    return dataclasses.replace(no_grasps(request.hand), meta={"hand": request.hand.name, "refused": reason})


def no_grasps(hand: Hand) -> Grasps:
    """Return no grasps of a hand."""
    f = len(hand.tips)

    def none(*shape: int) -> torch.Tensor:
        return torch.zeros(0, *shape, dtype=torch.float64)

    contacts = Contacts(none(f, 3), none(f, 3), none(f), none(f))
    certificate = Certificate(none(), none(), none(), none().bool(), none(6))
    return Grasps(
        none(hand.dof), none(hand.dof), none(3), none(4, 4), contacts, none(f).long(), none(f), none(), none(f),
        certificate, none(), none().long(),
    )  # fmt: skip


def _plan_or_refuse(request: Request) -> Grasps:
    """Return the grasps of a request, or none with the reason."""
    try:
        return plan_request(request)
    except MissingExtra:
        raise
    except GraspError as error:
        return refused(request, " ".join(str(error).split()))


def _plan_to_file(
    cloud: dict[str, np.ndarray], device: str, hand: HandSource, spec: Any, rest: dict[str, Any], file: Path
) -> None:
    """Plan in a worker, on a device."""
    points = PointCloud(**{name: torch.from_numpy(array) for name, array in cloud.items()}).to(torch.device(device))
    loaded = load_hand(hand.urdf_path.parent, hand.option)
    _plan_or_refuse(Request(points, loaded, _restored(spec), **rest)).save(file)


def _arrays(value: PointCloud | Plane) -> dict[str, np.ndarray]:
    """Return the tensors of a value as arrays: tensors would be shared among processes."""
    return {name: x.cpu().numpy() for name, x in named_tensors(value).items()}


def _plain(spec: ContactSpec | None) -> Any:
    """Return a spec without tensors, and its table's normal and offset."""
    if spec is None or not isinstance(spec.table, Plane):
        return spec
    return dataclasses.replace(spec, table=None), spec.table.normal.cpu().numpy(), spec.table.offset


def _restored(plain: Any) -> ContactSpec | None:
    """Return the spec of `_plain`."""
    if not isinstance(plain, tuple):
        return plain
    spec, normal, offset = plain
    return dataclasses.replace(spec, table=Plane(torch.from_numpy(normal), offset))
