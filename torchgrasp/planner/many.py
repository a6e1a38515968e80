"""Plans of many clouds: one after another, on processes, or all at once on an accelerator."""

import dataclasses
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchgrasp.errors import BadArgument, GraspError, MissingExtra
from torchgrasp.files import temporary_folder
from torchgrasp.hand.hand import Hand, HandSource
from torchgrasp.hand.load import load_hand
from torchgrasp.jobs import run_tasks
from torchgrasp.planner.batches import plan_hands
from torchgrasp.planner.problem import Problem, settle_hand
from torchgrasp.planner.request import Request
from torchgrasp.planner.run import finish, plan_request
from torchgrasp.values import Certificate, Contacts, Grasps, PointCloud, load_grasps


def plan_many(clouds: Sequence[PointCloud], workers: int, given: dict[str, Any]) -> list[Grasps]:
    """Plan for each cloud on its device; a bad cloud does not affect the others.

    `given` holds the other arguments of `Request`, common to all clouds. A worker process gives up a cloud after an
    hour.
    """
    for name in ("shape", "observer", "reachable"):
        if given.get(name) is not None:
            raise BadArgument(name, "one for many clouds", "None for many clouds")
    for cloud in clouds:
        _ = Request(cloud, **given).hands  # wrong fingers are refused
    if not workers:
        planned = _plan_together([Request(cloud, **given) for cloud in clouds])
    else:
        hand = given["hand"].source
        source = HandSource(hand.option, hand.urdf_path, hand.sha256)
        rest = {name: _with_arrays(value) for name, value in given.items() if name != "hand"}
        with temporary_folder() as folder:
            files = [folder / f"{k}.safetensors" for k in range(len(clouds))]
            sent = [(_with_arrays(cloud), str(cloud.points.device)) for cloud in clouds]
            tasks = [(*cloud, source, rest, file) for cloud, file in zip(sent, files, strict=True)]
            planned = [
                load_grasps(file) if end is None else _refused(given["hand"], end.sentence)
                for file, end in zip(files, run_tasks(_plan_to_file, tasks, workers, 3600.0), strict=True)
            ]
    return [grasps.to(cloud.points.device) for cloud, grasps in zip(clouds, planned, strict=True)]


def _plan_together(requests: Sequence[Request]) -> list[Grasps]:
    """Plan requests that differ in their clouds alone: one after another, or in stacks where an accelerator plans."""
    most = 256  # clouds at once: with more, their rows hardly fit into the memory
    devices = {request.cloud.points.device for request in requests if isinstance(request.cloud, PointCloud)}
    one = len(devices) == 1 and torch.device("cpu") not in devices
    if not one or requests[0].mode != "joint" or len(requests[0].hands) > 1:
        return [_plan_or_refuse(request) for request in requests]
    return [grasps for k in range(0, len(requests), most) for grasps in plan_stack(requests[k : k + most], *devices)]


def plan_stack(requests: Sequence[Request], device: torch.device) -> list[Grasps]:
    """Plan requests at once on a device; shapes are estimated on the CPU.

    A bad cloud gives an empty set of grasps, and does not affect the others.
    """
    found, problems = dict[int, Grasps](), dict[int, Problem]()
    hand, budget = settle_hand(requests[0].hands[0], torch.device("cpu")), requests[0].time_budget
    deadline = math.inf if budget is None else time.monotonic() + budget
    for k, request in enumerate(requests):
        try:
            problems[k] = Problem.of(dataclasses.replace(request, cloud=request.cloud.to("cpu")), hand).prepared()
        except MissingExtra:
            raise
        except GraspError as error:
            found[k] = _refused(request.hand, " ".join(str(error).split()))
    if problems:
        planned = plan_hands(list(problems.values()), deadline, device)
        for (k, problem), batches in zip(problems.items(), planned, strict=True):
            found[k] = finish(requests[k], [problem.give_back(grasps.to("cpu")) for grasps in batches])
    return [found[k].to(device) for k in range(len(requests))]


def _plan_or_refuse(request: Request) -> Grasps:
    """Return the grasps of a request; if its cloud is bad, return an empty set with the reason in `meta`."""
    try:
        return plan_request(request)
    except MissingExtra:
        raise
    except GraspError as error:
        return _refused(request.hand, " ".join(str(error).split()))


def _refused(hand: Hand, reason: str) -> Grasps:
    """Return an empty set of grasps, whose `meta` gives the reason why planning was refused."""
    return dataclasses.replace(no_grasps(hand), meta={"hand": hand.name, "refused": reason})


def no_grasps(hand: Hand) -> Grasps:
    """Return an empty set of grasps that has the joints and fingers of a hand."""
    f = len(hand.tips)

    def none(*shape: int) -> torch.Tensor:
        return torch.zeros(0, *shape, dtype=torch.float64, device="cpu")

    contacts = Contacts(none(f, 3), none(f, 3), none(f), none(f))
    certificate = Certificate(none(), none(), none(), none().bool(), none(6))
    return Grasps(
        none(hand.dof), none(hand.dof), none(3), none(4, 4), contacts, none(f).long(), none(f), none(), none(f),
        certificate, none(), none().long(), known=none().bool(), interval=none(2),
    )  # fmt: skip


def _plan_to_file(cloud: Any, device: str, hand: HandSource, rest: dict[str, Any], file: Path) -> None:
    """Plan for one cloud in a worker process, and save the grasps to a file."""
    points = _with_tensors(cloud).to(torch.device(device))
    given = {name: _with_tensors(value) for name, value in rest.items()}
    _plan_or_refuse(Request(points, load_hand(hand.urdf_path.parent, hand.option), **given)).save(file)


def _with_arrays(value: Any) -> Any:
    """Return a dataclass as a pair of its class and its fields, with tensors as NumPy arrays, for another process."""
    if isinstance(value, torch.Tensor):
        return value.detach().cpu().numpy()
    if dataclasses.is_dataclass(value):
        return type(value), {f.name: _with_arrays(getattr(value, f.name)) for f in dataclasses.fields(value)}
    return value


def _with_tensors(sent: Any) -> Any:
    """Return the value that `_with_arrays` packed, with tensors in place of the arrays."""
    if isinstance(sent, np.ndarray):
        return torch.from_numpy(sent)
    if isinstance(sent, tuple) and isinstance(sent[0], type):
        return sent[0](**{name: _with_tensors(field) for name, field in sent[1].items()})
    return sent
