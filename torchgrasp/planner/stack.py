"""The planning problems of several clouds as one: their objects stacked, so that all their rows are
solved at once.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.contacts.plan import plan_chunk, stages_for
from torchgrasp.contacts.problem import ContactProblem, ShapeLike, rows_of
from torchgrasp.contacts.starts import start_chunks
from torchgrasp.foundation.base import join, settle
from torchgrasp.geometry.field_batch import FieldBatch
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.candidates import GraspProblem
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.joint import JointProblem
from torchgrasp.ik.seeds import PostureLibrary
from torchgrasp.planner.problem import Problem, settle_hand
from torchgrasp.shape.batch import ShapeBatch
from torchgrasp.success.body import EstimatedBody
from torchgrasp.success.features import GRIP
from torchgrasp.values.planning import Certificate, ContactPlan, Contacts

Owner = Int[Tensor, "b"]
"""The index of the cloud to which each row belongs."""


@dataclasses.dataclass(frozen=True)
class Stack:
    """The problems of c clouds, which share hand and request: the fields have one row for each
    cloud.

    The fields of a single problem are its own values, which are those of all rows.
    """

    problems: tuple[Problem, ...]
    hand: Hand
    shape: ShapeLike
    constraints: ContactProblem
    body: EstimatedBody
    world: CollisionWorld

    @classmethod
    def of(cls, problems: Sequence[Problem], device: torch.device | None = None) -> "Stack":
        """Stack problems without scenes, moved to a device; a single problem stays as it is unless
        it is moved.
        """
        first = problems[0]
        if len(problems) == 1 and device in (None, first.shape.device):
            constraints = ContactProblem.of(first.shape, first.spec)
            return cls((first,), first.hand, first.shape, constraints, first.body, first.world)
        device = first.shape.device if device is None else device
        shape = ShapeBatch.of([problem.shape for problem in problems], device)
        rings = shape.scales.new_tensor([problem.spec.ring_radius for problem in problems])
        bodies = [problem.body for problem in problems]
        field = FieldBatch.of([body.field for body in bodies]).to(device)  # pyright: ignore[reportArgumentType]
        numbers = (
            shape.scales.new_tensor([getattr(b, name) for b in bodies])
            for name in ("size", "height", "breadth")
        )
        body = EstimatedBody(
            shape, field, torch.stack([b.center for b in bodies]).to(device), *numbers
        )
        plane = first.spec.plane
        world = CollisionWorld(field, None if plane is None else plane.to(device))
        constraints = ContactProblem.of(shape, first.spec, rings)
        return cls(
            tuple(problems), settle_hand(first.hand, device), shape, constraints, body, world
        )

    def __len__(self) -> int:
        """Return the number of clouds."""
        return len(self.problems)

    @property
    def first(self) -> Problem:
        """The problem of the first cloud, for what all have in common."""
        return self.problems[0]

    @cached_property
    def loads(self) -> Float[Tensor, "c w 6"] | None:
        """The wrenches [N, N m] about the origin that grasps of each cloud must resist, or None."""
        loads = [problem.loads for problem in self.problems if problem.loads is not None]
        return torch.stack(loads).to(self.body.center) if loads else None

    @property
    def strongest(self) -> float:
        """The greatest normal force [N] of a finger in the task."""
        task = self.first.request.grasp_task
        return task.pressing(task.lifts(self.first.spec.plane)) or GRIP

    @cached_property
    def library(self) -> PostureLibrary:
        """Random postures of the hand, from which initial postures near contacts are chosen."""
        library = PostureLibrary.of(self.first.hand, self.first.postures, self.first.request.seed)
        return settle(library, self.body.center.device)

    def plans(self) -> Iterator[tuple[ContactPlan, Owner]]:
        """Yield the plan of each batch that has new guesses, with the cloud of each row.

        A single cloud is planned batch by batch. Several clouds are planned at once, before the
        first batch.
        """
        sizes = [batch.starts for batch in self.first.batches if batch.starts]
        if len(self) == 1:
            drawn = self.first.draw()
            for size in sizes:
                parts = [self._plan(next(drawn), None) for _ in start_chunks(size)]
                yield join([plan for plan, _ in parts]), torch.cat([owner for _, owner in parts])
            return
        most = 2**17  # rows at once, whose temporaries an accelerator holds
        first = torch.stack([problem.drawn for problem in self.problems])
        owners = torch.arange(len(self)).repeat_interleave(first.shape[1])
        pairs = zip(first.flatten(0, 1).split(most), owners.split(most), strict=True)
        parts = [self._plan(*pair) for pair in pairs]
        plan = join([plan for plan, _ in parts])
        owner = torch.cat([owner for _, owner in parts])
        index = torch.arange(len(owner), device=owner.device).view(first.shape[:2])
        for rows in index.split(sizes, 1):
            yield plan[rows.flatten()], owner[rows.flatten()]

    def _plan(
        self, first: Float[Tensor, "b f 3"], owner: Tensor | None
    ) -> tuple[ContactPlan, Owner]:
        """Return the contact plan from initial guesses, and the cloud of each row; by default the
        first cloud.
        """
        device = self.body.center.device
        owner = (
            torch.zeros(len(first), dtype=torch.long, device=device)
            if owner is None
            else owner.to(device)
        )
        shape = rows_of(self.shape, owner)
        constraints = self.constraints.rows(owner)
        return plan_chunk(shape, constraints, first.to(device), stages_for(self.first.spec)), owner

    def reach(self, contacts: Contacts, certificate: Certificate, owner: Owner) -> GraspProblem:
        """Return the inverse kinematics problem of reaching contacts, with their certificate of
        force closure.
        """
        center = self.body.rows(owner).center
        one = self.first
        return GraspProblem(
            self.hand,
            contacts,
            certificate,
            self.world.rows(owner),
            center,
            one.reachable,
            one.descends,
        )

    def slide(self, owner: Owner) -> JointProblem:
        """Return the problem of hand and sliding contacts together, for rows of the given clouds."""
        world = self.world.rows(owner)
        return JointProblem(
            self.hand, rows_of(self.shape, owner), self.constraints.rows(owner), world
        )


def by_cloud(owner: Owner, clouds: int) -> list[Int[Tensor, "k"]]:
    """Return the indices of the rows of each cloud, in their order; on the CPU for more than one
    cloud.
    """
    if clouds == 1:
        return [torch.arange(len(owner), device=owner.device)]
    owner = owner.cpu()
    order = torch.argsort(owner, stable=True)
    count = torch.bincount(owner, minlength=clouds)
    return list(order.split(count.tolist()))
