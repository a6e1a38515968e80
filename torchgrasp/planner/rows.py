"""The contact sets of a plan that the hand tries, and the state of each in the search for grasps.

A contact set is named by its row, which is its index in the `Candidates`. Here b counts contact
sets, c objects, and k such indices.
"""

import dataclasses
import enum
from collections.abc import Callable, Iterator, Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.contacts.certify import certify
from torchgrasp.contacts.plan import plan_chunk, stages_for
from torchgrasp.contacts.problem import rows_of
from torchgrasp.contacts.resist import resist_loads, share_carried
from torchgrasp.contacts.starts import STARTS_PER_CHUNK
from torchgrasp.foundation.base import (
    at_once,
    flatnonzero,
    join,
    lexical_order,
    rank_in_group,
    row_numbers,
)
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import Status
from torchgrasp.foundation.rules import Count
from torchgrasp.geometry.linalg import farthest_points
from torchgrasp.ik.attempts import assign, seed_costs
from torchgrasp.ik.seeds import nearest_postures, query_mixture
from torchgrasp.planner.objects import CloudIndex, Objects
from torchgrasp.posture_model.mixture import PAPER_ENERGY
from torchgrasp.success.loads import (
    lever_arm,
    squeezing_forces,
    squeezing_strength,
    strength_of,
)
from torchgrasp.values.planning import Certificate, ContactPlan, Contacts, Grasps, IKSeeds
from torchgrasp.values.specs import ContactSpec


class Row(enum.IntEnum):
    """The state of a contact set in the search for grasps."""

    SEEDED = 0
    """The contact set has force closure and initial hand postures. No grasp was tried yet."""
    BEGUN = 1
    """A few solver steps for the hand, with fixed contacts, gave no executable grasp."""
    STUCK = 2
    """All solver steps for the hand, with fixed contacts, gave no executable grasp."""
    ENDED = 3
    """The search ended: a grasp is executable, or contacts that slide with the hand failed, too."""


@dataclasses.dataclass(frozen=True)
class ChoiceNumbers:
    """Parameters by which planned contact sets are chosen for the hand to try."""

    likely: int = 2
    """Number of sets of least cost, for each set to try, among which farthest-point sampling
    chooses.
    """
    weak: float = 1e6
    """Cost of a contact set that does not resist the task's loads: above all other costs."""
    tried: int = 2
    """Number of a contact set's initial postures that count for its cost: as many as the solver
    refines.
    """
    lever: float = 0.3
    """Weight in the cost of the logarithm of the load's lever arm. The logarithm of the fingertips'
    squared errors has the weight 1.
    """
    short: float = 0.1
    """Lever arm (no unit, of `lever_arm`) that is added to all: below it, differences hardly count.
    """
    touching: float = 1e-3
    """Sum of squared errors [mm2] below which initial postures count as equally near."""


CHOICE = ChoiceNumbers()


@dataclasses.dataclass(frozen=True)
class Candidates:
    """The b contact sets of a plan that have force closure, and the state of each.

    Args:
        contacts: the contact sets, points [m] in the upright frame.
        certificate: the proofs of force closure.
        seeds: initial hand postures; `seeds.row` is the index of each one's contact set.
        load: the wrench [N, N m] about the contacts' centroid that is hardest to resist. It needs
            the largest share of the greatest finger forces, of all wrenches of the task. Without
            loads it is the weight in a lift, else 0.
        cost: cost (no unit; less is better) by which the next contact sets to try are chosen.
        cloud: index of each contact set's object.
        status: the state of each contact set, a `Row`.
        turn: number of the batch in which each contact set was first tried, from 1; 0 if it was
            not.
        grasp: index in `grasps` of each tried contact set's best grasp, or -1.
        grasps: the best grasps of the tried contact sets; None if there are none yet.
    """

    contacts: Contacts
    certificate: Certificate
    seeds: IKSeeds
    load: Float[Tensor, "b 6"]
    cost: Float[Tensor, "b"]
    cloud: CloudIndex
    status: Int[Tensor, "b"]
    turn: Int[Tensor, "b"]
    grasp: Int[Tensor, "b"]
    grasps: Grasps | None = None

    @classmethod
    def of(
        cls,
        contacts: Contacts,
        certificate: Certificate,
        seeds: IKSeeds,
        load: Float[Tensor, "b 6"],
        cost: Float[Tensor, "b"],
        cloud: CloudIndex,
    ) -> "Candidates":
        """Return contact sets of which none was tried: all have the status `SEEDED`.

        The arguments are the fields of the same name.
        """
        zero = torch.zeros_like(cloud)
        return cls(
            contacts, certificate, seeds, load, cost, cloud, zero + Row.SEEDED, zero, zero - 1
        )

    def __len__(self) -> int:
        """Return the number of contact sets."""
        return len(self.cloud)

    def find(self, status: Row, clouds: Bool[Tensor, "c"] | None = None) -> Int[Tensor, "k"]:
        """Return the indices of the contact sets in the state `status`, in the order in which they
        were tried.

        `clouds` is a mask of the c objects whose contact sets count; None means all objects.
        """
        chosen = self.status == status
        if clouds is not None:
            chosen = chosen & clouds[self.cloud]
        rows = flatnonzero(chosen)
        return rows[torch.argsort(self.turn[rows], stable=True)]

    def select(self, rows: Int[Tensor, "k"]) -> tuple[Contacts, Certificate, IKSeeds]:
        """Return contacts, certificates and initial postures of the k contact sets with the indices
        `rows`.

        The `row` of the initial postures is an index among these k.
        """
        number = rows.new_full((len(self),), -1)
        number[rows] = row_numbers(rows)
        seeds = self.seeds[number[self.seeds.row] >= 0]
        seeds = seeds[torch.argsort(number[seeds.row], stable=True)]
        seeds = dataclasses.replace(seeds, row=number[seeds.row])
        return self.contacts[rows], self.certificate[rows], seeds

    def begin(self, rows: Int[Tensor, "k"], turn: int) -> "Candidates":
        """Return all contact sets; those with the indices `rows` are marked as first tried in batch
        number `turn`.
        """
        return dataclasses.replace(self, turn=self.turn.index_fill(0, rows, turn))

    def put(self, rows: Int[Tensor, "k"], grasps: Grasps, status: Int[Tensor, "k"]) -> "Candidates":
        """Return all contact sets; those with the indices `rows` get new best grasps and states.

        `grasps` and `status` hold one grasp and one state (`Row`) for each of the k indices.
        """
        before = 0 if self.grasps is None else len(self.grasps)
        index = torch.arange(before, before + len(rows), device=rows.device)
        return dataclasses.replace(
            self,
            status=self.status.index_copy(0, rows, status),
            grasp=self.grasp.index_copy(0, rows, index),
            grasps=grasps if self.grasps is None else join([self.grasps, grasps]),
        )

    def best(self, rows: Int[Tensor, "k"]) -> Grasps:
        """Return the best grasp so far of each of the k contact sets with the indices `rows`, in
        their order.

        Every one of these sets must have been tried.
        """
        assert self.grasps is not None
        return self.grasps[self.grasp[rows]]


def join_candidates(parts: Sequence[Candidates]) -> Candidates:
    """Return several groups of contact sets, with their states, as one group, in order.

    Only the first group may hold `grasps`, which the result keeps.
    """
    first = 0
    seeds = list[IKSeeds]()
    for part in parts:
        seeds.append(dataclasses.replace(part.seeds, row=part.seeds.row + first))
        first += len(part)
    columns = ("load", "cost", "cloud", "status", "turn", "grasp")
    return Candidates(
        contacts=join([part.contacts for part in parts]),
        certificate=join([part.certificate for part in parts]),
        seeds=join(seeds),
        grasps=parts[0].grasps,
        **{name: torch.cat([getattr(part, name) for part in parts]) for name in columns},
    )


def draw(objects: Objects, sizes: Sequence[int]) -> Iterator[tuple[ContactPlan, CloudIndex]]:
    """Plan contacts; yield for each batch the contact sets, and the index of each set's object.

    A contact set is planned from each initial guess. `sizes` are the numbers of initial guesses in
    the batches, for each object. A CPU plans batch by batch. An accelerator plans all batches
    before the first, because each launch costs it more than further contact sets.
    """
    starts = torch.stack(objects.starts)  # (c, s, f, 3)
    clouds = len(objects)
    groups = [[size] for size in sizes] if objects.device.type == "cpu" else [list(sizes)]
    begin = 0
    for group in groups:
        count = sum(group)
        first = starts[:, begin : begin + count].flatten(0, 1).to(objects.device)
        cloud = torch.arange(clouds, device=objects.device).repeat_interleave(count)
        begin += count
        most = at_once(first, STARTS_PER_CHUNK)
        parts = [
            plan_chunk(
                rows_of(objects.shape, own),
                objects.constraints.rows(own),
                part,
                stages_for(objects.spec),
            )
            for part, own in zip(first.split(most), cloud.split(most), strict=True)
        ]
        plan = join(parts)
        index = torch.arange(clouds * count, device=objects.device).view(clouds, count)
        for rows in index.split(group, 1):
            yield plan[rows.flatten()], cloud[rows.flatten()]


def find_candidates(
    objects: Objects,
    plan: ContactPlan,
    cloud: CloudIndex,
    most: int,
    note: Callable[..., None],
) -> Candidates:
    """Return the chosen contact sets that have force closure, with their initial hand postures.

    Of the sets of each object that satisfy all constraints, at most `most` are chosen, which lie
    far apart. In mode "paper" with ranking "variance" all are chosen, the most certain first.
    Chosen sets without force closure are left out. A set whose greatest finger forces do not resist
    the loads is not chosen. In the plan it gets the status `NOT_RESISTED`. The costs are 0 until
    `with_costs` sets them.

    Args:
        objects: the objects of the plan.
        plan: the planned contact sets.
        cloud: index of each planned set's object.
        most: largest number of sets that are chosen for each object.
        note: function, such as `Report.note`, that is called with the name and the result of each
            stage: "plan", "certify" and "query".
    """
    request = objects.request
    load = plan.contacts.points.new_zeros(len(plan), 6)
    if objects.loads is not None:
        plan, load = _drop_weak(objects, plan, cloud, load)
    elif objects.lifts:
        load = objects.weight_on(plan.contacts, cloud)
    note("plan", plan)
    if request.mode == "paper" and request.order == "variance":
        variance = plan.contacts.variance
        assert variance is not None
        rows = flatnonzero(plan.status == Status.OK)
        rows = rows[torch.argsort(variance[rows].sum(1), stable=True)]
    else:
        rows = _spread(plan, cloud, most, len(objects))
    certificate = certify(plan.contacts[rows], objects.spec)
    closed = flatnonzero(certificate.closed)
    certificate = certificate[closed]
    kept = rows[closed]
    contacts = plan.contacts[kept]
    note("certify", certificate, offered=len(rows))
    seeds = find_seeds(objects, contacts, cloud[kept])
    note("query", seeds)
    cost = torch.zeros_like(certificate.margin)
    return Candidates.of(contacts, certificate, seeds, load[kept], cost, cloud[kept])


def _drop_weak(
    objects: Objects, plan: ContactPlan, cloud: CloudIndex, load: Float[Tensor, "b 6"]
) -> tuple[ContactPlan, Float[Tensor, "b 6"]]:
    """Return the plan, in which sets that cannot resist the task have failed, and the worst load of
    each set.
    """
    assert objects.loads is not None
    rows = flatnonzero(plan.status == Status.OK)
    points = plan.contacts.points[rows]
    normals = plan.contacts.normals[rows]
    full = torch.full_like(points[..., 0], objects.strongest)
    proof = resist_loads(points, normals, full, objects.loads[cloud[rows]], objects.spec)
    weak = rows[~(proof.margin >= 1)]
    status = plan.status.index_fill(0, weak, int(Status.NOT_RESISTED))
    return dataclasses.replace(plan, status=status), load.index_copy(0, rows, proof.load)


def _spread(plan: ContactPlan, cloud: CloudIndex, most: int, clouds: int) -> Int[Tensor, "k"]:
    """Return at most `most` successful contact sets of each cloud that lie far apart."""
    solved = flatnonzero(plan.status == Status.OK)
    own = by_cloud(cloud[solved], clouds)
    if max(map(len, own)) > most:  # the host chooses
        found = plan[solved].to("cpu")
        own = [rows[spread_rows(found[rows], most)] for rows in own]
    return solved[torch.cat(own).to(solved.device)]


@checked
def spread_rows(plan: ContactPlan, most: Count) -> Int[Tensor, "k"]:
    """Return the indices, ascending, of at most `most` contact sets of a plan that satisfy all
    constraints.

    Their status is `OK`. Farthest-point sampling of the contacts' coordinates chooses sets that
    differ much.
    """
    rows = flatnonzero(plan.status == Status.OK)
    if len(rows) <= most:
        return rows
    first = int(plan.quality[rows].argmin())
    points = sorted_points(plan.contacts[rows])
    return rows[farthest_points(points, most, first=first).sort().values]


def find_seeds(objects: Objects, contacts: Contacts, cloud: CloudIndex) -> IKSeeds:
    """Return initial hand postures near the contacts of b sets.

    Contacts [m] are in the upright frame, and `cloud` (b,) is the index of each set's object. In
    mode "joint" they are random postures, in other modes those of the learned model.
    """
    mixture = objects.model.mixture
    if mixture is None:
        world = objects.world.rows(cloud)
        return nearest_postures(objects.library, contacts, world, reachable=objects.reachable)
    if objects.request.mode == "paper":
        return query_mixture(objects.hand, contacts, mixture, n_seeds=1, max_energy=PAPER_ENERGY)
    return query_mixture(objects.hand, contacts, mixture)


def with_costs(objects: Objects, found: Candidates) -> Candidates:
    """Return `found` with the cost of each contact set (no unit; less is better).

    The cost is log(max(e, 0.001)) + 0.3 log(a + 0.1), with the numbers of `CHOICE`. Here a is the
    lever arm of the set's load, without unit (`lever_arm`). The number e [mm2] is the lesser sum of
    squared errors of the first two initial postures. It is infinite without any. The errors are
    those of fingertip positions, pad directions and clearances (`seed_costs`).

    The initial postures of each set are first sorted: those that carry the most of the load come
    first. There may be loads to resist, or a weight to lift. Then a set whose postures all carry
    less costs 1e6 to 2e6 more (`CHOICE.weak`). A weight is carried with the whole mean friction.
    Without this surcharge, two fingers at a pan's thin wall and one on its floor would do.
    """
    contacts = found.contacts
    seeds = found.seeds
    weak = torch.zeros_like(found.certificate.margin)
    share = torch.ones_like(seeds.energy)
    if objects.lifts or objects.loads is not None:
        spec = objects.spec_without_margin if objects.loads is None else objects.spec
        share = _carried(objects, found, spec)
        weak = weak.scatter_reduce(0, seeds.row, share, "amax")
        weak = torch.where(weak < 1, CHOICE.weak * (2 - weak), 0.0)
    seeds = _sort_seeds(objects, found, share)
    first = seeds[rank_in_group(seeds.row) < CHOICE.tried]
    reach = objects.reach(contacts, found.certificate, found.cloud)
    residual = seed_costs(reach, first)
    least = torch.full((len(contacts),), torch.inf, dtype=residual.dtype, device=residual.device)
    least = least.scatter_reduce(0, first.row, residual, "amin")
    arm = lever_arm(contacts.points, objects.body.rows(found.cloud).center)
    missed = least.clamp_min(CHOICE.touching).log()
    cost = missed + CHOICE.lever * (arm + CHOICE.short).log() + weak
    return dataclasses.replace(found, seeds=seeds, cost=cost)


def _sort_seeds(objects: Objects, found: Candidates, share: Float[Tensor, "g"]) -> IKSeeds:
    """Return the initial postures of each contact set in the order in which they are tried.

    Those that carry the greatest `share` of the load (at most 1) come first, and the nearest of
    them first of all: it is most likely to reach the contacts. The others with this share follow,
    the strongest first (`squeezing_strength`). On the same contacts, one posture may squeeze twice
    as hard as another.
    """
    contacts = found.contacts
    seeds = found.seeds
    forces = squeezing_forces(contacts)[seeds.row[:, None], seeds.permutation]
    strength = squeezing_strength(
        objects.hand, seeds, assign(contacts, seeds), forces, objects.strongest
    )
    further = (rank_in_group(seeds.row, -share) > 0).int()
    return seeds[lexical_order(seeds.row, further, -share, -strength)]


def _carried(objects: Objects, found: Candidates, spec: ContactSpec) -> Float[Tensor, "g"]:
    """Return which share of its set's load, at most 1, the fingers of each initial posture can
    carry.

    A set may carry its load with the least strength of its postures at each contact. It then
    carries it in all of them. So most sets need one linear programme.
    """
    contacts = found.contacts
    seeds = found.seeds
    strength = strength_of(objects.hand, seeds, assign(contacts, seeds), objects.strongest)
    at_contact = torch.empty_like(strength).scatter(1, seeds.permutation, strength)
    least = strength.new_full(contacts.points.shape[:2], objects.strongest)
    rows = seeds.row[:, None].expand_as(at_contact)
    least = least.scatter_reduce(0, rows, at_contact, "amin")
    share = share_carried(contacts, least, found.load, spec)[seeds.row]
    # one wait for the device saves a programme for each of the other postures
    doubtful = flatnonzero(share < 1)
    own = seeds.row[doubtful]
    share[doubtful] = share_carried(contacts[own], at_contact[doubtful], found.load[own], spec)
    return share


def choose(rows: Candidates, most: int, clouds: int) -> Int[Tensor, "k"]:
    """Return the indices of the next contact sets to try: at most `most` of each object.

    Farthest-point sampling chooses them among the 2 `most` untried sets of least cost. They are far
    from each other, and from the sets that were tried before. `rows` are all contact sets, and
    `clouds` is the number of objects. All objects are sampled at once, on their device.
    """
    if not len(rows):
        return rows.cloud
    points = sorted_points(rows.contacts)
    before = flatnonzero(rows.turn > 0)
    cost = rows.cost.index_fill(0, before, torch.inf)
    # the cheapest rows of each cloud, (c, m)
    table, held = _table(rows.cloud, clouds)
    least, order = torch.where(held, cost[table], torch.inf).sort(dim=1, stable=True)
    index = table.gather(1, order)[:, : CHOICE.likely * most]
    likely = _are_likely(least[:, : CHOICE.likely * most], most)
    x = points[index]  # (c, m, 3 f)
    nearest = torch.full_like(likely, torch.inf, dtype=x.dtype)
    if len(before):
        earlier, held = _table(rows.cloud[before], clouds)  # (c, e)
        # (c, m, e)
        gaps = (x[:, :, None] - points[before[earlier]][:, None]).square().sum(-1)
        nearest = torch.where(held[:, None], gaps, torch.inf).amin(2)
    picks = list[Tensor]()
    for _ in range(min(most, index.shape[1])):
        # the first of the largest
        pick = torch.where(likely, nearest, -1.0).argmax(1, keepdim=True)
        picks.append(pick)
        one = x.gather(1, pick[..., None].expand(-1, -1, x.shape[2]))
        nearest = torch.minimum(nearest, (x - one).square().sum(-1))
    chosen = index.gather(1, torch.cat(picks, 1))
    known = torch.arange(chosen.shape[1], device=index.device) < likely.sum(1, keepdim=True)
    chosen = torch.where(known, chosen, len(rows)).sort(1).values.flatten()
    return chosen[flatnonzero(chosen < len(rows))]


def _are_likely(cost: Float[Tensor, "*c m"], most: int) -> Bool[Tensor, "*c m"]:
    """Return for ascending costs of m contact sets a mask of those to choose from.

    Beyond the first `most`, only contact sets that resist the task's loads are chosen from.
    """
    needed = torch.arange(cost.shape[-1], device=cost.device) < most
    return torch.isfinite(cost) & ((cost < CHOICE.weak) | needed)


def _table(cloud: CloudIndex, clouds: int) -> tuple[Int[Tensor, "c m"], Bool[Tensor, "c m"]]:
    """Return the indices of the contact sets of each object, in their order. Return also a mask of
    the entries that hold one.
    """
    count = torch.bincount(cloud, minlength=clouds)
    table = cloud.new_zeros(clouds, int(count.max()))
    table[cloud, rank_in_group(cloud)] = row_numbers(cloud)
    return table, torch.arange(table.shape[1], device=cloud.device) < count[:, None]


def by_cloud(cloud: CloudIndex, clouds: int) -> list[Int[Tensor, "k"]]:
    """Return for each object the indices of its contact sets, ascending, on the CPU.

    `cloud` is the index of each contact set's object, and `clouds` the number of objects.
    """
    cloud = cloud.cpu()
    count = torch.bincount(cloud, minlength=clouds)
    return list(torch.argsort(cloud, stable=True).split(count.tolist()))


def sorted_points(contacts: Contacts) -> Float[Tensor, "b d"]:
    """Return each contact set as one vector of d = 3 f coordinates [m].

    Its f contacts are sorted by ascending z.
    """
    order = torch.argsort(contacts.points[..., 2], dim=1, stable=True)
    return contacts.points.gather(1, order[..., None].expand(-1, -1, 3)).flatten(1)
