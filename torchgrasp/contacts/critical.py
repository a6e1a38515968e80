"""The least friction at which contacts can balance, and the forces that need it.

Forces f_i on the object with the outward normals n_i have the normal parts a_i = -n_i . f_i, and
the tangential parts t_i. G maps them to their total force and torque. The critical friction is the
least mu for which

    G f = 0,    sum a_i = number of contacts,    x_i = (mu a_i, t_i) in the cone |t_i| <= mu a_i

has a solution. The multipliers are s_i of the cones, y of the balance and l of the sum. With the
linear map M_i, for which x_i = M_i f_i, the best forces satisfy

    M_i^T s_i = G_i^T y + l n_i,    sum a_i s_i0 = 1,    x_i o s_i = nu e,    nu -> 0.

The twist y is a motion of the object, along which friction of the coefficient mu just stops all
contacts. Newton's method with the scaling of Nesterov and Todd [1] solves the equations for falling
nu. The three numbers of a contact scale as the cone itself does. With the scaling point w of x and
s, D = (2 J w w^T J - J) / beta maps x to s. Its inverse is beta (2 w w^T - J).

[1] Andersen, Roos and Terlaky, Mathematical Programming 95, 2003.
"""

import dataclasses
from typing import Annotated, Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.contacts.balance import grasp_map
from torchgrasp.contacts.form_closure import Vectors, scaled_arms
from torchgrasp.foundation.base import FINGERTIPS, flatnonzero, row_numbers
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import ANY, is_known
from torchgrasp.foundation.threads import single_threaded
from torchgrasp.geometry.frames import degenerate
from torchgrasp.geometry.linalg import eye_like, matvec, norm
from torchgrasp.shape.kernel import is_plain


@dataclasses.dataclass(frozen=True)
class CriticalNumbers:
    """Parameters of Newton's method for the critical friction."""

    most: float = 10.0
    """Greatest friction coefficient; contacts that need more count as unable to balance."""
    exact: float = 1e-6
    """The last nu: the result is larger than the critical friction by about 2 nu a contact."""
    steps: int = 40
    """Most steps; most contact sets need fewer than 15."""
    first: float = 1.5
    """The first friction coefficient, as a multiple of what the first forces need."""
    above: float = 0.2
    """Added to the first friction coefficient."""
    pushing: float = 0.05
    """Least normal force of first forces that balance; otherwise the first forces are normal."""
    within: float = 0.9
    """Share of the way to the edge of the cones that a step goes at most."""
    shorter: tuple[float, ...] = (1.0, 0.8, 0.5, 0.2, 0.05)
    """Shares of a step that are tried, since the product mu a_i is not linear."""
    power: float = 0.6
    """Exponent of the part of nu that the next step keeps; the base is what a step to nu = 0 leaves
    undone.
    """
    short: float = 0.3
    """A step with a lesser share is short: the next one keeps mu and nu."""
    stuck: float = 0.05
    """If a step that keeps mu has a lesser share, mu is too small for any balanced forces."""
    raised: float = 1.5
    """Factor by which mu then grows, so that steps come free of the cones' edges."""
    off: float = 0.1
    """Largest error of sum a_i s_i0 after the last step: it and the balance are not linear."""
    polishing: int = 2
    """Number of whole steps at the end, which leave nothing but rounding."""
    rounding: float = 1e-6
    """Largest resultant of forces that balance, for normal forces of about 1."""


CRITICAL = CriticalNumbers()


class LeastBalance(NamedTuple):
    """Balanced forces that need the least friction, with the multipliers that prove it.

    Args:
        forces: forces f on the object (b, f, 3), with a mean normal force of 1.
        friction: the friction coefficient mu (b,).
        press: multipliers s_0 of the cones (b, f).
        slide: tangential multipliers of the cones (b, f, 3).
        twist: motion y of the object (b, 6), in the units of `scaled_arms`.
        scale: multiplier l of the sum of the normal forces (b,).
    """

    forces: Vectors
    friction: Float[Tensor, "b"]
    press: Float[Tensor, "b f"]
    slide: Vectors
    twist: Float[Tensor, "b 6"]
    scale: Float[Tensor, "b"]

    def plus(self, other: "LeastBalance", share: Float[Tensor, "b"]) -> "LeastBalance":
        """Return the sum of this one and a share of the other one."""
        shares = [share.reshape(-1, *[1] * (x.ndim - 1)) for x in self]
        return LeastBalance(*(x + s * d for x, s, d in zip(self, shares, other, strict=True)))

    def rows(self, rows: Tensor) -> "LeastBalance":
        """Return some of the rows."""
        return LeastBalance(*(x[rows] for x in self))


@checked(gradients=True)
@single_threaded
def critical_friction(
    points: Annotated[Float[Tensor, "*b f 3"], ANY],
    normals: Annotated[Float[Tensor, "*b f 3"], ANY],
) -> Float[Tensor, "*b"]:
    """Return the least friction coefficient (*b,) at which contacts have force closure.

    The coefficient is the same for all contacts of a set. At any greater friction there are
    balanced forces inside all friction cones, and at any lesser one there are none. The result is
    infinite for:

    * contacts that cannot balance at a friction up to 10 (`CRITICAL.most`);
    * contacts on a line;
    * contacts that are not finite;
    * the few contacts for which the method does not converge.

    The result is differentiable twice. At a kink, where several derivatives are possible, the
    derivative is one of them.

    Args:
        points: positions (*b, f, 3) [m] of the f contacts of each set, 3 to 5.
        normals: outward unit normals (*b, f, 3) of the object, in the same frame.

    Raises `BadArgument` for another number of contacts, or tensors of different shapes.

    >>> points = torch.tensor([[0.0, 1, 0], [0, 0, 0], [1, 0.5, 0]])
    >>> normals = torch.tensor([[-1.0, 0, 0], [-1, 0, 0], [0.8, 0, 0.6]])
    >>> f"{float(critical_friction(points, normals)):.3f}"
    '0.750'
    """
    f = points.shape[-2]
    if not FINGERTIPS[0] <= f <= FINGERTIPS[1]:
        raise BadArgument("points", f"{f} contacts a set", "3 to 5 contacts")
    flat = points.reshape(-1, f, 3).double()
    rows, found = least_balance(flat, normals.reshape(-1, f, 3).double())
    needed = torch.where(found.friction.isnan(), torch.inf, found.friction)
    friction = flat.new_full((len(flat),), torch.inf).index_put((rows,), needed)
    return friction.to(points).reshape(points.shape[:-2])


def least_balance(
    points: Vectors, normals: Vectors, load: Float[Tensor, "b 6"] | None = None
) -> tuple[Int[Tensor, "k"], LeastBalance]:
    """Return the indices of the k contact sets that can balance, and their balances.

    The balances are differentiable twice in all arguments. Where several motions of the object
    prove the friction, its derivative is that of one of them. Inside torch.vmap, all sets have an
    index; the friction of those that cannot balance is NaN, and their other fields mean nothing.

    Args:
        points: positions [m] of f contacts.
        normals: outward unit normals of the object.
        load: wrench that the contacts balance, in the units of `scaled_arms`, over the mean normal
            force; None means no load. Few sets fail to converge, most of them under loads far below
            the normal forces.
    """
    load = points.new_zeros(len(points), 6) if load is None else load
    good, *parts = _Search.apply(points.detach(), normals.detach(), load.detach())
    if is_known(good):
        rows = flatnonzero(good)
        inputs = points[rows], normals[rows], load[rows]
        found = LeastBalance(*(x[rows] for x in parts))
    else:
        # finite numbers stand in for sets that cannot balance, so that their derivatives are 0
        rows = row_numbers(good)
        stand = eye_like(max(FINGERTIPS), points)[: points.shape[1], :3]
        inputs = tuple(
            _where(good, x, y) for x, y in ((points, stand), (normals, stand), (load, 1.0))
        )
        found = LeastBalance(*(_where(good, x, 1.0) for x in parts))
    if not is_plain(points, normals, load):
        found = _follow(found, *inputs)
    if not is_known(good):
        found = found._replace(friction=_where(good, found.friction, torch.nan))
    return rows, found


def _follow(
    found: LeastBalance, points: Vectors, normals: Vectors, load: Float[Tensor, "b 6"]
) -> LeastBalance:
    """Return the same balances, with their derivatives by points, normals and load."""
    # Newton's steps at the solution change the derivatives alone: the first step those of first
    # order, the second step those of second order.
    cones = _Cones.of(points, normals, load)
    for _ in range(2):
        found = cones.refined(found)
    return found


def _where(good: Bool[Tensor, "b"], x: Float[Tensor, "b *d"], other: float | Tensor) -> Tensor:
    """Return the rows of `x` that are good, and in place of others a number or a row."""
    return torch.where(good.reshape(-1, *[1] * (x.ndim - 1)), x, other)


class _Search(torch.autograd.Function):
    """The search for balances, without derivatives.

    Its results are the mask of the contact sets that can balance, and the fields of their
    `LeastBalance`; those of others are NaN.
    """

    @staticmethod
    def forward(
        points: Vectors, normals: Vectors, load: Float[Tensor, "b 6"]
    ) -> tuple[Tensor, ...]:
        """Return the mask and the fields for all contact sets."""
        rows, found = _search(points, normals, load)
        for _ in range(CRITICAL.polishing):
            found = _Cones.of(points[rows], normals[rows], load[rows]).nearer(found)
        good = torch.zeros_like(load[:, 0], dtype=torch.bool).index_fill(0, rows, True)
        parts = (x.new_full((len(good), *x.shape[1:]), torch.nan) for x in found)
        return good, *(x.index_copy(0, rows, y) for x, y in zip(parts, found, strict=True))

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        """Say that no result has a derivative."""
        ctx.mark_non_differentiable(*output)

    @staticmethod
    def backward(ctx: Any, *_: Any) -> tuple[None, ...]:
        """Return no derivatives."""
        return None, None, None

    @staticmethod
    def jvp(ctx: Any, *_: Any) -> tuple[None, ...]:
        """Return no changes of the results."""
        return (None,) * (1 + len(LeastBalance._fields))

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[int | None, ...], *args: Tensor
    ) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        """Search together for the balances of all entries of the mapped axis."""
        rows = [
            x.expand(info.batch_size, *x.shape) if axis is None else x.movedim(axis, 0)
            for x, axis in zip(args, in_dims, strict=True)
        ]
        found = _Search.apply(*(x.flatten(0, 1) for x in rows))
        size = rows[0].shape[:2]
        return tuple(x.unflatten(0, size) for x in found), (0,) * len(found)


def _search(
    points: Vectors, normals: Vectors, load: Float[Tensor, "b 6"]
) -> tuple[Int[Tensor, "k"], LeastBalance]:
    """Return the result of `least_balance`, without derivatives."""
    numbers = CRITICAL
    finite = torch.isfinite(points) & torch.isfinite(normals)
    finite = finite.flatten(1).all(1) & torch.isfinite(load).all(1)
    left = flatnonzero(finite & ~degenerate(points))
    cones = _Cones.of(points[left], normals[left], load[left])
    at = cones.first()
    whole = points.new_ones(len(left))
    shorter = whole.new_tensor(numbers.shorter)
    last = whole
    found_rows = list[Tensor]()
    found = list[LeastBalance]()
    for _ in range(numbers.steps):
        held = last < numbers.short
        still, centring = cones.directions(at, held)
        mean = cones.products(at).mean(1)
        undone = (1 - cones.longest(at, still)).clamp(0, 1)
        kept = torch.where(held, 1.0, undone**numbers.power)
        target = (kept * mean).clamp_min(numbers.exact)
        change = still.plus(centring, target)
        share = (numbers.within * cones.longest(at, change)).clamp_max(1)
        tried = share[:, None] * shorter
        inside = cones.inside(at, change, tried)
        share = tried.gather(1, inside.double().argmax(1, keepdim=True))[:, 0]
        at = at.plus(change, share)
        stuck = held & (share < numbers.stuck)
        at = at._replace(friction=torch.where(stuck, numbers.raised, 1.0) * at.friction)
        off = ((cones.split(at.forces)[0] * at.press).sum(1) - 1).abs()
        settled = (share == 1) & (target == numbers.exact) & (off <= numbers.off)
        last = share
        lost = ~(at.friction < 2 * numbers.most)
        going = flatnonzero(~(settled | lost))
        if len(going) == len(last):
            continue
        ended = flatnonzero(settled & (cones.resultant(at) <= numbers.rounding))
        found_rows.append(left[ended])
        found.append(at.rows(ended))
        left = left[going]
        at = at.rows(going)
        cones = _Cones(*(x[going] for x in cones))
        last = last[going]
        if len(left) == 0:
            break
    found_rows.append(left[:0])
    found.append(at.rows(left[:0]))
    rows = torch.cat(found_rows)
    joined = LeastBalance(*(torch.cat(x) for x in zip(*found, strict=True)))
    order = torch.argsort(rows)
    order = order[joined.friction[order] <= numbers.most]
    return rows[order], joined.rows(order)


class _Cones(NamedTuple):
    """The friction cones of b contact sets: the normals, the rows of G and of the sum of normal
    forces (b, 7, f, 3), and the load that the forces balance.
    """

    normals: Vectors
    rows: Float[Tensor, "b 7 f 3"]
    load: Float[Tensor, "b 6"]

    @classmethod
    def of(cls, points: Vectors, normals: Vectors, load: Float[Tensor, "b 6"]) -> "_Cones":
        """Return the cones of contacts."""
        balance = grasp_map(scaled_arms(points)).unflatten(2, (-1, 3))
        return cls(normals, torch.cat([balance, normals[:, None]], 1), load)

    def first(self) -> LeastBalance:
        """Return the start: equal pushes, made to balance where they then push everywhere."""
        numbers = CRITICAL
        n = self.normals
        b, f, _ = n.shape
        grasp = self.rows[:, :6].flatten(2)
        total = self.load[..., None] - grasp @ n.flatten(1)[..., None]
        needed, _ = torch.linalg.solve_ex(grasp @ grasp.mT, total)
        balanced = -n - (grasp.mT @ needed)[..., 0].view(b, f, 3)
        pushes = (-_dot(balanced, n) > numbers.pushing).all(1)[:, None, None]
        forces = torch.where(pushes, balanced, -n)
        forces = forces * (f / -_dot(forces, n).sum(1))[:, None, None]
        push, tangential = self.split(forces)
        friction = (
            numbers.first * (_dot(tangential, tangential).sqrt() / push).amax(1) + numbers.above
        )
        ahead = friction[:, None] * push
        press = ahead / _form(ahead, tangential)
        slide = -tangential / _form(ahead, tangential)[..., None]
        nu = 1 / (press * push).sum(1)
        slide = nu[:, None, None] * slide
        twist = n.new_zeros(b, 6)
        return LeastBalance(forces, friction, nu[:, None] * press, slide, twist, -2 * nu)

    def split(self, forces: Float[Tensor, "*b f 3"]) -> tuple[Tensor, Tensor]:
        """Return normal and tangential parts of forces."""
        push = -_dot(forces, self.normals)
        return push, forces + push[..., None] * self.normals

    def products(self, at: LeastBalance) -> Float[Tensor, "b f"]:
        """Return half of x_i . s_i, the nu of each contact."""
        push, tangential = self.split(at.forces)
        return (at.friction[:, None] * push * at.press + _dot(tangential, at.slide)) / 2

    def resultant(self, at: LeastBalance) -> Float[Tensor, "b"]:
        """Return the length of the total wrench of forces and load."""
        return norm(matvec(self.rows[:, :6].flatten(2), at.forces.flatten(1)) + self.load)

    def longest(self, at: LeastBalance, change: LeastBalance) -> Float[Tensor, "b"]:
        """Return the largest share of a change for which all x_i and s_i stay in their cones, to
        first order.
        """
        push, tangential = self.split(at.forces)
        more, across = self.split(change.forces)
        friction = at.friction[:, None]
        ahead = friction * more + change.friction[:, None] * push
        first = _way(friction * push, tangential, ahead, across)
        second = _way(at.press, at.slide, change.press, change.slide)
        return torch.minimum(first, second).amin(1)

    def inside(
        self, at: LeastBalance, change: LeastBalance, shares: Float[Tensor, "b s"]
    ) -> Bool[Tensor, "b s"]:
        """Return for each of s shares of a change whether the forces stay in the cones."""
        push, tangential = self.split(at.forces)
        more, across = self.split(change.forces)
        share = shares[..., None]  # (b, s, 1)
        normal = push[:, None] + share * more[:, None]
        crossed, squared = (_dot(x, across)[:, None] for x in (tangential, across))
        sideways = _dot(tangential, tangential)[:, None] + share * (2 * crossed + share * squared)
        friction = at.friction[:, None] + shares * change.friction[:, None]
        good = (normal > 0) & ((friction[..., None] * normal) ** 2 > sideways)
        return good.all(-1) & (friction > 0)

    def nearer(self, at: LeastBalance) -> LeastBalance:
        """Return the balance after a whole step to the last nu, or the same one if the step would
        leave a cone, as on a kink.
        """
        still, centring = self.directions(at)
        whole = torch.ones_like(at.friction)
        change = still.plus(centring, CRITICAL.exact * whole)
        stays = self.inside(at, change, whole[:, None])[:, 0] & (self.longest(at, change) > 1)
        return at.plus(change, stays.to(whole))

    def refined(self, at: LeastBalance) -> LeastBalance:
        """Return the balance after a whole step to the last nu, without elimination of unknowns.

        It is slower than `nearer`. But the matrix stays regular for small nu, so that derivatives
        of the step are exact.
        """
        f = self.normals.shape[1]
        unknowns = [at.forces, at.press, at.slide, at.friction, at.twist, at.scale]
        matrix, residual = self.equations(at)
        step, _ = torch.linalg.solve_ex(matrix, residual)
        sizes = [3 * f, f, 3 * f, 1, 6, 1]
        parts = zip(unknowns, step.split(sizes, 1), strict=True)
        forces, press, slide, friction, twist, scale = (x - d.view(x.shape) for x, d in parts)
        return LeastBalance(forces, friction, press, slide, twist, scale)

    def equations(self, at: LeastBalance) -> tuple[Float[Tensor, "b q q"], Float[Tensor, "b q"]]:
        """Return the Jacobian and the residual of the q = 7 f + 8 equations.

        The unknowns are forces, press, slide, friction, twist and scale. The equations are those of
        balance and sum, of the multipliers by contact, of sum a_i s_i0, and of x_i o s_i: its first
        number, then the others, by contact.
        """
        n = self.normals[..., None]  # (b, f, 3, 1)
        mu = at.friction[:, None, None, None]
        push, tangential = (x[..., None] for x in self.split(at.forces))
        push = push[..., None]  # (b, f, 1, 1)
        press = at.press[..., None, None]
        slide = at.slide[..., None]
        x = mu * push
        identity = eye_like(3, n)
        flat = identity - n @ n.mT
        rows = self.rows.flatten(2)  # (b, 7, 3 f)
        none = torch.zeros_like
        # each block by contact: forces, press, slide, friction
        lacking = none(flat), -mu * n, identity.expand_as(flat), -press * n
        weighed = -press * n.mT, push, none(n.mT), none(push)
        along = -mu * press * n.mT + slide.mT @ flat, x, tangential.mT, push * press
        across = -mu * slide @ n.mT + press * flat, tangential, x * identity, push * slide
        matrix = [
            _widened(rows, 4 * n.shape[1] + 8),
            torch.cat([_by_contact(*lacking), -rows.mT], 2),
            _widened(_summed(*weighed), 7),
            _widened(_by_contact(*along), 7),
            _widened(_by_contact(*across), 7),
        ]
        multipliers = torch.cat([at.twist, at.scale[:, None]], 1)[..., None]
        pressed = torch.full_like(self.load[:, :1], n.shape[1])
        total = matvec(rows, at.forces.flatten(1)) + torch.cat([self.load, pressed], 1)
        pull = (slide - mu * press * n).flatten(1)
        residual = [
            total,
            pull - (rows.mT @ multipliers)[..., 0],
            (push * press).sum(1)[:, :, 0] - 1,
            (x * press + tangential.mT @ slide).flatten(1) - CRITICAL.exact,
            (x * slide + press * tangential).flatten(1),
        ]
        return torch.cat(matrix, 1), torch.cat(residual, 1)

    def directions(
        self, at: LeastBalance, held: Bool[Tensor, "b"] | None = None
    ) -> tuple[LeastBalance, LeastBalance]:
        """Return Newton's step to nu = 0, and its change for each unit of nu.

        The friction does not change where `held`. Forces and cone multipliers are eliminated: the
        eight unknowns left are the twist, the scale and the friction.
        """
        push, tangential = self.split(at.forces)
        x = at.friction[:, None] * push
        scaling = _Scaling.of(x, tangential, at.press, at.slide)
        softness = scaling.softness(self.normals, at.friction)
        stiff = (2 * scaling.ahead**2 - 1) / scaling.beta
        by_friction = self._by_friction(at, push, stiff, scaling)
        rows = torch.cat([self.rows, by_friction[:, None]], 1)  # (b, 8, f, 3)
        softened = _soften(rows, softness)
        matrix = softened.flatten(2) @ rows.flatten(2).mT
        corner = eye_like(8, self.normals)[7]
        last = (push**2 * stiff).sum(1)
        matrix = matrix - last[:, None, None] * (corner[:, None] * corner)
        # what the forces would do if the eight unknowns did not change: for both directions
        inverse_x = 1 / _form(x, tangential)
        still = _soften(self._lacking(at)[:, None], softness)[:, 0] - at.forces
        free = torch.stack([still, self._centring(at)], 1)  # (b, 2, f, 3)
        right = free.flatten(2) @ rows.flatten(2).mT  # (b, 2, 8)
        right = right + self._residuals(at, (push * x * inverse_x).sum(1))
        if held is not None:
            matrix[held, 7] = corner
            right[held, :, 7] = 0
        solved, _ = torch.linalg.solve_ex(matrix, right.mT)
        solved = solved.mT  # (b, 2, 8)
        forces = free - (solved @ softened.flatten(2)).unflatten(2, self.normals.shape[1:])
        twist, scale, friction = solved.split([6, 1, 1], 2)
        # the change of the multipliers follows from that of x: D and the scaling point give it
        n = self.normals[:, None]
        more = -_dot(forces, n)
        sideways = forces + more[..., None] * n
        more = at.friction[:, None, None] * more + push[:, None] * friction
        press = torch.stack([-at.press, x * inverse_x], 1)
        slide = torch.stack([-at.slide, -tangential * inverse_x[..., None]], 1)
        ahead, across = scaling.stiffened(more, sideways)
        press = press - ahead
        slide = slide + across
        parts = (forces, friction[..., 0], press, slide, twist, scale[..., 0])
        first, second = (LeastBalance(*(x[:, i] for x in parts)) for i in range(2))
        return first, second

    def _by_friction(
        self,
        at: LeastBalance,
        push: Float[Tensor, "b f"],
        stiff: Float[Tensor, "b f"],
        scaling: "_Scaling",
    ) -> Vectors:
        """Return how the equations of the multipliers, by contact, change with the friction."""
        ahead = (at.press - at.friction[:, None] * push * stiff)[..., None] * self.normals
        return ahead - (2 * push * scaling.ahead / scaling.beta)[..., None] * scaling.across

    def _lacking(self, at: LeastBalance) -> Vectors:
        """Return what M_i^T s_i lacks to G_i^T y + l n_i."""
        multipliers = torch.cat([at.twist, at.scale[:, None]], 1)
        pull = at.slide - (at.friction[:, None] * at.press)[..., None] * self.normals
        return pull - torch.einsum("br,brfi->bfi", multipliers, self.rows)

    def _centring(self, at: LeastBalance) -> Vectors:
        """Return the change of the forces for each unit of nu: that of the inverses of s_i."""
        inverse_s = 1 / _form(at.press, at.slide)
        pull = (at.press / at.friction[:, None])[..., None] * self.normals
        return -inverse_s[..., None] * (at.slide + pull)

    def _residuals(self, at: LeastBalance, weighed: Float[Tensor, "b"]) -> Float[Tensor, "b 2 8"]:
        """Return the residuals of balance, sum and sum a_i s_i0, for both directions.

        `weighed` is the change of the last one for each unit of nu.
        """
        total = torch.einsum("brfi,bfi->br", self.rows, at.forces)
        pressed = torch.full_like(self.load[:, :1], self.normals.shape[1])
        total = total + torch.cat([self.load, pressed], 1)
        residual = torch.cat([total, torch.ones_like(weighed)[:, None]], 1)
        other = -weighed[:, None] * eye_like(8, total)[7]
        return torch.stack([residual, other], 1)


class _Scaling(NamedTuple):
    """The scaling points w = (ahead, across) of x and s by contact, and their factors beta."""

    ahead: Float[Tensor, "b f"]
    across: Vectors
    beta: Float[Tensor, "b f"]

    @classmethod
    def of(
        cls,
        x: Float[Tensor, "b f"],
        tangential: Vectors,
        press: Float[Tensor, "b f"],
        slide: Vectors,
    ) -> "_Scaling":
        """Return the scaling points of (x, tangential) and (press, slide)."""
        size_x = _form(x, tangential).sqrt()
        size_s = _form(press, slide).sqrt()
        both = x / size_x * (press / size_s)
        both = both + _dot(tangential, slide) / (size_x * size_s)
        half = 2 * ((1 + both) / 2).sqrt()
        ahead = (x / size_x + press / size_s) / half
        across = (tangential / size_x[..., None] - slide / size_s[..., None]) / half[..., None]
        return cls(ahead, across, size_x / size_s)

    def softness(self, normals: Vectors, friction: Float[Tensor, "b"]) -> Float[Tensor, "b f 3 3"]:
        """Return D^-1 in the space of forces: beta (2 w w^T + 1 - (1 + 1/mu^2) n n^T)."""
        mu = friction[:, None]
        point = self.across - (self.ahead / mu)[..., None] * normals
        steep = (1 + 1 / mu**2)[..., None] * normals
        softness = 2 * _outer(point, point) + eye_like(3, normals) - _outer(steep, normals)
        return self.beta[..., None, None] * softness

    def stiffened(
        self, ahead: Float[Tensor, "b c f"], across: Float[Tensor, "b c f 3"]
    ) -> tuple[Float[Tensor, "b c f"], Float[Tensor, "b c f 3"]]:
        """Return the two parts of D applied to c vectors for each contact, the second one negated."""
        inner = self.ahead[:, None] * ahead - _dot(self.across[:, None], across)
        ahead = (2 * self.ahead[:, None] * inner - ahead) / self.beta[:, None]
        across = 2 * inner[..., None] * self.across[:, None] - across
        return ahead, across / self.beta[:, None, :, None]


def _soften(
    z: Float[Tensor, "b c f 3"], softness: Float[Tensor, "b f 3 3"]
) -> Float[Tensor, "b c f 3"]:
    """Return the products of vectors by contact with the contact's softness."""
    return (z.transpose(1, 2) @ softness).transpose(1, 2)


def _by_contact(*blocks: Float[Tensor, "b f r _"]) -> Float[Tensor, "b m q"]:
    """Return the rows of equations that stand for each contact: its blocks for forces, press and
    slide on the diagonals, then that of the common friction.
    """
    *own, common = blocks
    f = common.shape[1]
    each = eye_like(f, common)[:, None, :, None]
    diagonal = [(x[:, :, :, None] * each).flatten(3).flatten(1, 2) for x in own]
    return torch.cat([*diagonal, common.flatten(1, 2)], 2)


def _widened(x: Float[Tensor, "b m k"], columns: int) -> Float[Tensor, "b m q"]:
    """Return a matrix with further columns of zeros, for unknowns that are not in its equations."""
    return torch.cat([x, x.new_zeros(*x.shape[:2], columns)], 2)


def _summed(*blocks: Float[Tensor, "b f 1 _"]) -> Float[Tensor, "b 1 q"]:
    """Return the row of an equation that sums over contacts."""
    *own, common = blocks
    return torch.cat([*(x.flatten(1)[:, None] for x in own), common.sum(1)], 2)


def _dot(a: Float[Tensor, "*b 3"], b: Float[Tensor, "*c 3"]) -> Float[Tensor, "*e"]:
    """Return the dot products of vectors; three terms are faster than a sum over a short axis."""
    x, y, z = (a * b).unbind(-1)
    return x + y + z


def _outer(a: Float[Tensor, "*b 3"], b: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Return the outer products of vectors."""
    return a[..., None] * b[..., None, :]


def _form(ahead: Float[Tensor, "*b"], across: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
    """Return ahead^2 - |across|^2, which is positive inside the cone."""
    return ahead**2 - _dot(across, across)


def _way(
    ahead: Float[Tensor, "*b"],
    across: Float[Tensor, "*b 3"],
    more: Float[Tensor, "*b"],
    sideways: Float[Tensor, "*b 3"],
) -> Float[Tensor, "*b"]:
    """Return the way from a point in the cone along a direction to the cone's edge; infinite if it
    never ends.
    """
    a = _form(more, sideways)
    b = ahead * more - _dot(across, sideways)
    c = _form(ahead, across)
    root = (b**2 - a * c).clamp_min(0).sqrt()
    q = -(b + torch.where(b >= 0, root, -root))
    ends = torch.stack([q / a, c / q], -1)
    return torch.where(ends > 0, ends, torch.inf).amin(-1)
