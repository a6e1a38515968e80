"""The least friction at which contacts can balance, and the forces that need it.

Forces f_i on the object have the normal parts a_i = -n_i . f_i, and the tangential parts t_i. The
vectors n_i are the outward normals. G maps them to their total force and torque. The critical
friction is the least mu for which

    G f = 0,    sum a_i = number of contacts,    x_i = (mu a_i, t_i) in the cone |t_i| <= mu a_i

has a solution. The multipliers are s_i of the cones, y of the balance and l of the sum. With the
linear map M_i, for which x_i = M_i f_i, the best forces satisfy

    M_i^T s_i = G_i^T y + l n_i,    sum a_i s_i0 = 1,    x_i o s_i = nu e,    nu -> 0.

The twist y is a motion of the object, along which friction of the coefficient mu just stops all
contacts. Newton's method with the scaling of Nesterov and Todd [1] solves the equations for falling
nu. Take a frame of the contact whose first axis is the inward normal. In it M_i is diag(mu, 1, 1),
and the form of the cone is J = diag(1, -1, -1). With the scaling point w of x and s, the matrix D =
(2 J w w^T J - J) / beta maps x to s. Its inverse is beta (2 w w^T - J).

Where compiled loops are used, one of them takes the same steps (`fused_critical`).

[1] Andersen, Roos and Terlaky, Mathematical Programming 95, 2003.
"""

import dataclasses
import functools
from typing import Annotated, Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.contacts.balance import grasp_map
from torchgrasp.contacts.certify import check_unit
from torchgrasp.contacts.form_closure import Vectors, count_contacts, scaled_arms, with_torque
from torchgrasp.foundation.base import FINGERTIPS, flatnonzero, map_rows, row_numbers
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.fused import is_fused
from torchgrasp.foundation.rules import ANY, is_known
from torchgrasp.foundation.threads import single_threaded
from torchgrasp.geometry.frames import degenerate
from torchgrasp.geometry.linalg import across, dot, eye_like, matvec, norm
from torchgrasp.shape.kernel import is_plain


@dataclasses.dataclass(frozen=True)
class CriticalNumbers:
    """Parameters of Newton's method for the critical friction.

    It is an interior-point method. mu is the friction coefficient. nu is the product of a cone and
    its multiplier, which falls towards 0. a_i are the normal forces, and s_i0 the multipliers of
    the cones along the inward normals. The sum of a_i s_i0 should be 1.
    """

    most: float = 10.0
    """Greatest friction coefficient; contacts that need more count as unable to balance."""
    exact: float = 1e-6
    """The last nu: the result is larger than the critical friction by about 2 nu a contact."""
    steps: int = 50
    """Greatest number of steps of the method; most contact sets need fewer than 15."""
    first: float = 1.5
    """Multiple of the friction that the first forces need, for the first friction coefficient."""
    above: float = 0.2
    """Number that is added to this multiple."""
    pushing: float = 0.05
    """Least normal force of first forces that balance. If one is less, the first forces are along
    the normals.
    """
    within: float = 0.9
    """Share of the way to the edge of the cones that a step goes at most."""
    shorter: tuple[float, ...] = (1.0, 0.8, 0.5, 0.2, 0.05)
    """Shares of a step that are tried, since the product mu a_i is not linear."""
    power: float = 0.6
    """Exponent of the part of nu that the next step keeps. The base is what a step to nu = 0 leaves
    undone.
    """
    short: float = 0.3
    """Share of a step below which it is short: the next one keeps mu and nu."""
    stuck: float = 0.05
    """Share of a step that keeps mu, below which mu is too small for any balanced forces."""
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
    """Balanced forces of b contact sets that need the least friction. The Lagrange multipliers
    prove that no lesser friction is enough.

    Vectors are in the frame of the contact points. Lengths are divided by the root-mean-square
    radius of the contacts (`scaled_arms`), so nothing has a unit.

    Args:
        forces: forces f on the object (b, f, 3), with a mean normal force of 1.
        friction: the friction coefficient mu (b,).
        press: multipliers s_0 (b, f) of the friction cones: their parts along the inward normals.
        slide: multipliers (b, f, 3) of the friction cones: their parts tangential to the surface.
        twist: multiplier y (b, 6) of the balance, a motion of the object: velocity of the contacts'
            centroid, then angular velocity.
        scale: multiplier l (b,) of the sum of the normal forces.
    """

    forces: Vectors
    friction: Float[Tensor, "b"]
    press: Float[Tensor, "b f"]
    slide: Vectors
    twist: Float[Tensor, "b 6"]
    scale: Float[Tensor, "b"]


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

    Raises `BadArgument` for another number of contacts, tensors of different shapes, or normals
    that are not of length 1 (to 1e-3).

    >>> points = torch.tensor([[0.0, 1, 0], [0, 0, 0], [1, 0.5, 0]])
    >>> normals = torch.tensor([[-1.0, 0, 0], [-1, 0, 0], [0.8, 0, 0.6]])
    >>> f"{float(critical_friction(points, normals)):.3f}"
    '0.750'
    """
    f = count_contacts(points)
    flat = points.reshape(-1, f, 3).double()
    rows, found = least_balance(flat, check_unit(normals.reshape(-1, f, 3).double()))
    needed = torch.where(found.friction.isnan(), torch.inf, found.friction)
    friction = flat.new_full((len(flat),), torch.inf).index_put((rows,), needed)
    return friction.to(points).reshape(points.shape[:-2])


def least_balance(
    points: Vectors, normals: Vectors, load: Float[Tensor, "b 6"] | None = None
) -> tuple[Int[Tensor, "k"], LeastBalance]:
    """Return the indices of the k contact sets that can balance, and their balances of least
    friction.

    The balances are differentiable twice in all arguments. At a kink, where several derivatives are
    possible, the derivative is one of them. Inside torch.vmap, all sets have an index. For those
    that cannot balance the friction is NaN, and the other fields mean nothing.

    Args:
        points: positions (b, f, 3) [m] of the f contacts of each set.
        normals: outward unit normals (b, f, 3) of the object, in the same frame.
        load: wrench (force, then torque about the contacts' centroid) that the contacts balance.
            Forces are divided by the mean normal force, and lengths by the root-mean-square radius
            of the contacts. None means no load. Few sets fail to converge, most of them under loads
            far below the normal forces.
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
    # Newton's steps at the solution change the derivatives alone. The first step changes those of
    # first order, the second step those of second order.
    equations = _Equations.of(points, normals, load)
    for _ in range(2):
        found = equations.refined(found)
    return found


def _where(good: Bool[Tensor, "b"], x: Float[Tensor, "b *d"], other: float | Tensor) -> Tensor:
    """Return the rows of `x` that are good, and in place of others a number or a row."""
    return torch.where(good.reshape(-1, *[1] * (x.ndim - 1)), x, other)


class _Search(torch.autograd.Function):
    """The search for balances, without derivatives.

    Its results are the mask of the contact sets that can balance, and the fields of their
    `LeastBalance`. The fields of other sets are NaN.
    """

    @staticmethod
    def forward(
        points: Vectors, normals: Vectors, load: Float[Tensor, "b 6"]
    ) -> tuple[Tensor, ...]:
        """Return the mask and the fields for all contact sets."""
        rows, found = _search(points, normals, load)
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
        return map_rows(_Search.apply, info.batch_size, in_dims, args)


def _search(
    points: Vectors, normals: Vectors, load: Float[Tensor, "b 6"]
) -> tuple[Int[Tensor, "k"], LeastBalance]:
    """Return the result of `least_balance`, without derivatives."""
    numbers = CRITICAL
    finite = torch.isfinite(points) & torch.isfinite(normals)
    finite = finite.flatten(1).all(1) & torch.isfinite(load).all(1)
    left = flatnonzero(finite & ~degenerate(points))
    axes = torch.stack([-normals, *across(normals)], 2)  # (b, f, 3 axes, 3)
    if is_fused(points, normals, load):
        from torchgrasp.contacts import fused_critical  # it imports numba

        good, parts = fused_critical.search(points[left], axes[left], load[left], numbers)
        return left[good], LeastBalance(*(x[good] for x in parts))
    every = _Cones.of(points, axes, load)
    cones = every.some(left)
    at = cones.first()
    last = torch.ones_like(at.friction)
    shorter = last.new_tensor(numbers.shorter)[:, None]
    found_rows = list[Tensor]()
    found = list[_Balance]()
    for _ in range(numbers.steps):
        held = last < numbers.short
        scaling = _Scaling.of(at, cones.flip)
        still, centring = cones.directions(at, scaling, held)
        mean = _sum(scaling.products(), 0) / (2 * points.shape[1])
        undone = (1 - scaling.longest(still)).clamp(0, 1)
        kept = torch.where(held, 1.0, undone**numbers.power)
        target = (kept * mean).clamp_min(numbers.exact)
        change = still.plus(centring, target)
        share = (numbers.within * scaling.longest(change)).clamp_max(1)
        tried = share * shorter  # (s, b)
        inside = at.inside(change, tried)
        share = tried.gather(0, inside.double().argmax(0, keepdim=True))[0]
        at = at.after(change, share)
        stuck = held & (share < numbers.stuck)
        at = at._replace(friction=torch.where(stuck, numbers.raised, 1.0) * at.friction)
        off = (_sum(at.forces[0] * at.multipliers[0], 0) - 1).abs()
        settled = (share == 1) & (target == numbers.exact) & (off <= numbers.off)
        last = share
        lost = ~(at.friction < 2 * numbers.most)
        going = flatnonzero(~(settled | lost))
        if len(going) == len(last):
            continue
        ended = flatnonzero(settled & (norm(cones.total(at.forces).T) <= numbers.rounding))
        found_rows.append(left[ended])
        found.append(at.some(ended))
        left = left[going]
        at = at.some(going)
        cones = cones.some(going)
        last = last[going]
        if len(left) == 0:
            break
    found_rows.append(left[:0])
    found.append(at.some(left[:0]))
    rows = torch.cat(found_rows)
    at = _Balance(*(torch.cat(x, -1) for x in zip(*found, strict=True)))
    order = torch.argsort(rows)
    order = order[at.friction[order] <= numbers.most]
    rows = rows[order]
    at = at.some(order)
    cones = every.some(rows)
    for _ in range(numbers.polishing):
        at = cones.nearer(at)
    return rows, at.along(axes[rows])


class _Change(NamedTuple):
    """A change of balances.

    The b contact sets are the last axis, here and below, since sums over short axes are then fast.

    Args:
        forces: change of the forces (3, f, b) in the frames of the contacts.
        cones: change of x and s (2, 3, f, b), that of x to first order.
        friction: change of mu (b,).
        motion: change of the twist y and the multiplier l (7, b).
    """

    forces: Float[Tensor, "3 f b"]
    cones: Float[Tensor, "2 3 f b"]
    friction: Float[Tensor, "b"]
    motion: Float[Tensor, "7 b"]

    def plus(self, other: "_Change", share: Float[Tensor, "b"]) -> "_Change":
        """Return the sum of this one and a share of the other one."""
        return _Change(*(x + share * d for x, d in zip(self, other, strict=True)))


class _Balance(NamedTuple):
    """Forces of b contact sets on the way to balance, and their multipliers.

    Args:
        forces: forces (3, f, b) in the frames of the contacts.
        multipliers: the multipliers s of the cones (3, f, b).
        friction: the friction coefficient mu (b,).
        motion: the twist y and the multiplier l (7, b).
    """

    forces: Float[Tensor, "3 f b"]
    multipliers: Float[Tensor, "3 f b"]
    friction: Float[Tensor, "b"]
    motion: Float[Tensor, "7 b"]

    def some(self, sets: Int[Tensor, "k"]) -> "_Balance":
        """Return those of some contact sets."""
        return _Balance(*(x.index_select(-1, sets) for x in self))

    def inside(self, change: _Change, shares: Float[Tensor, "s b"]) -> Bool[Tensor, "s b"]:
        """Return for each of s shares of a change whether the forces stay in the cones."""
        forces = self.forces + shares[:, None, None] * change.forces  # (s, 3, f, b)
        friction = self.friction + shares * change.friction
        push = forces[:, 0]
        good = (push > 0) & ((friction[:, None] * push) ** 2 > (forces[:, 1:] ** 2).sum(1))
        return good.all(1) & (friction > 0)

    def after(self, change: _Change, share: Float[Tensor, "b"]) -> "_Balance":
        """Return the balance after a share of a change."""
        forces = self.forces + share * change.forces
        multipliers = self.multipliers + share * change.cones[1]
        friction = self.friction + share * change.friction
        motion = self.motion + share * change.motion
        return _Balance(forces, multipliers, friction, motion)

    def along(self, axes: Float[Tensor, "b f 3 3"]) -> LeastBalance:
        """Return the balance for the axes (a, b, c) of the contacts."""
        press = self.multipliers[0].T
        forces, slide = (
            (x.permute(2, 1, 0)[..., None] * axes).sum(2) for x in (self.forces, self.multipliers)
        )
        slide = slide - press[..., None] * axes[:, :, 0]
        twist, scale = self.motion.T.split([6, 1], 1)
        return LeastBalance(forces, self.friction, press, slide, twist, scale[:, 0])


class _Scaling(NamedTuple):
    """The points x and s of the cones, whose scaling gives Newton's step.

    Args:
        stretch: the diagonals of M (3, 1, b).
        flip: the diagonal of J (3, 1, 1).
        cones: x and s (2, 3, f, b).
        flipped: J x and J s (2, 3, f, b).
        form: x^T J x and s^T J s (2, f, b), which are positive inside the cones.
    """

    stretch: Float[Tensor, "3 1 b"]
    flip: Float[Tensor, "3 1 1"]
    cones: Float[Tensor, "2 3 f b"]
    flipped: Float[Tensor, "2 3 f b"]
    form: Float[Tensor, "2 f b"]

    @classmethod
    def of(cls, at: _Balance, flip: Float[Tensor, "3 1 1"]) -> "_Scaling":
        """Return the points of a balance."""
        one = torch.ones_like(at.friction)
        stretch = torch.stack([at.friction, one, one])[:, None]
        cones = torch.stack([stretch * at.forces, at.multipliers])
        flipped = flip * cones
        return cls(stretch, flip, cones, flipped, (cones * flipped).sum(1))

    def products(self) -> Float[Tensor, "f b"]:
        """Return x . s, which is 2 nu."""
        x, s = self.cones
        return (x * s).sum(0)

    def longest(self, change: _Change) -> Float[Tensor, "b"]:
        """Return the largest share of a change for which all x and s stay in their cones, to first
        order.
        """
        along = (self.flipped * change.cones).sum(1)
        bend = (self.flip * change.cones**2).sum(1)
        root = (along**2 - self.form * bend).clamp_min(0).sqrt()
        return 1 / ((root - along) / self.form).amax((0, 1)).clamp_min(0)


class _Cones(NamedTuple):
    """The friction cones of b contact sets, and the eight equations of balance and sums.

    Args:
        rows: the rows of G and of the sum of normal forces (7, 3, f, b), for forces in the frames
            of the contacts.
        constants: the constants of the equations (8, b): the load, the number of contacts, and 1
            for sum a_i s_i0.
        flip: the diagonal of J (3, 1, 1).
    """

    rows: Float[Tensor, "7 3 f b"]
    constants: Float[Tensor, "8 b"]
    flip: Float[Tensor, "3 1 1"]

    @classmethod
    def of(
        cls, points: Vectors, axes: Float[Tensor, "b f 3 3"], load: Float[Tensor, "b 6"]
    ) -> "_Cones":
        """Return the cones of contacts with the given axes."""
        arms = scaled_arms(points)[:, :, None].expand_as(axes)
        grasp = with_torque(axes, arms).permute(3, 2, 1, 0)  # (6, 3, f, b)
        first = eye_like(3, points)[0][:, None, None]
        rows = torch.cat([grasp, -first.expand_as(grasp[:1])])
        one = torch.ones_like(load[:, 0])
        constants = torch.stack([*load.T, points.shape[1] * one, one])
        return cls(rows, constants, 2 * first - 1)

    def some(self, sets: Int[Tensor, "k"]) -> "_Cones":
        """Return those of some contact sets."""
        rows, constants = (x.index_select(-1, sets) for x in (self.rows, self.constants))
        return _Cones(rows, constants, self.flip)

    def first(self) -> _Balance:
        """Return the start: equal pushes, made to balance where they then push everywhere."""
        numbers = CRITICAL
        equal = -self.rows[6]
        grasp = self.rows[:6]
        gram = _products(grasp, grasp)
        needed = _solved(gram, self.total(equal)[:, None])
        balanced = equal - _sum(needed[:, :, None] * grasp, 0)
        pushes = (balanced[0] > numbers.pushing).all(0)
        forces = torch.where(pushes, balanced, equal)
        forces = self.constants[6] / _sum(forces[0], 0) * forces
        push = forces[0]
        ratio = (forces[1:] ** 2).sum(0).sqrt() / push
        friction = numbers.first * ratio.amax(0) + numbers.above
        x = torch.cat([friction * forces[:1], forces[1:]])
        flipped = self.flip * x
        inverse = flipped / (x * flipped).sum(0)
        nu = 1 / _sum(push * inverse[0], 0)
        motion = torch.stack([*torch.zeros_like(self.constants[:6]), -2 * nu])
        return _Balance(forces, nu * inverse, friction, motion)

    def total(self, forces: Float[Tensor, "3 f b"]) -> Float[Tensor, "6 b"]:
        """Return the total wrench of forces and load."""
        return _by_row(self.rows[:6] * forces) + self.constants[:6]

    def nearer(self, at: _Balance) -> _Balance:
        """Return the balance after a whole step to the last nu. If the step would leave a cone, as
        on a kink, return the same balance.
        """
        whole = torch.ones_like(at.friction)
        scaling = _Scaling.of(at, self.flip)
        still, centring = self.directions(at, scaling, whole < 1)
        change = still.plus(centring, CRITICAL.exact * whole)
        stays = at.inside(change, whole[None])[0] & (scaling.longest(change) > 1)
        return at.after(change, stays.to(whole))

    def directions(
        self, at: _Balance, scaling: _Scaling, held: Bool[Tensor, "b"]
    ) -> tuple[_Change, _Change]:
        """Return Newton's step to nu = 0, and its change for each unit of nu.

        The friction does not change where `held`. Forces and cone multipliers are eliminated: the
        eight unknowns left are the twist, the scale and the friction.
        """
        stretch, flip, (x, s), flipped, form = scaling
        push = at.forces[0]
        inverse_x, inverse_s = flipped / form[:, None]
        size_x, size_s = form.sqrt()
        beta = size_x / size_s
        gain = 1 + scaling.products() / (size_x * size_s)
        point = x / size_x + flipped[1] / size_s  # w sqrt(2 gain)
        stiff = flip * point / (beta * gain).sqrt()  # D = stiff stiff^T - J / beta
        soft = point * (beta / gain).sqrt() / stretch
        plain = flip * beta / stretch**2

        def softened(z: Float[Tensor, "*c 3 f b"]) -> Float[Tensor, "*c 3 f b"]:
            """Return products with M^-1 D^-1 M^-1."""
            return (z * soft).sum(-3, keepdim=True) * soft - plain * z

        by_friction = stretch * push * stiff[0] * stiff
        by_friction[0] -= s[0] + x[0] / beta
        by_friction = torch.where(held, 0.0, by_friction)
        rows = torch.cat([self.rows, by_friction[None]])  # (8, 3, f, b)
        soft_rows = softened(rows)
        matrix = _products(rows, soft_rows)
        matrix[7, 7] -= _sum(push**2 * (stiff[0] ** 2 - 1 / beta), 0)
        # what the forces would be if the eight unknowns did not change, and for each unit of nu
        lacking = stretch * s - _sum(self.rows * at.motion[:, None, None], 0)
        free = torch.stack([softened(lacking), inverse_s / stretch])  # (2, 3, f, b)
        right = _by_row(rows[:, None] * free)  # (8, 2, b)
        right[:, 0] += self.constants
        right[7, 1] -= _sum(push * inverse_x[0], 0)
        right[7] = torch.where(held, 0.0, right[7])
        solved = _solved(matrix, right)
        forces = free - _sum(soft_rows[:, None] * solved[:, :, None, None], 0)
        forces[0] -= at.forces
        friction = solved[7]
        # the change of s follows from that of x
        of_x = stretch * forces
        of_x[:, 0] += push * friction[:, None]
        of_s = flip / beta * of_x - (stiff * of_x).sum(1, keepdim=True) * stiff
        of_s[0] -= s
        of_s[1] += inverse_x
        cones = torch.stack([of_x, of_s], 1)
        parts = zip(forces, cones, friction, solved[:7].unbind(1), strict=True)
        still, centring = (_Change(*x) for x in parts)
        return still, centring


class _Equations(NamedTuple):
    """The equations of balances, for their derivatives. They hold the normals, the rows of G, and
    the rows (b, 7, f, 3) of the sum of normal forces. They also hold the load that the forces
    balance.
    """

    normals: Vectors
    rows: Float[Tensor, "b 7 f 3"]
    load: Float[Tensor, "b 6"]

    @classmethod
    def of(cls, points: Vectors, normals: Vectors, load: Float[Tensor, "b 6"]) -> "_Equations":
        """Return the equations of contacts."""
        balance = grasp_map(scaled_arms(points)).unflatten(2, (-1, 3))
        return cls(normals, torch.cat([balance, normals[:, None]], 1), load)

    def refined(self, at: LeastBalance) -> LeastBalance:
        """Return the balance after a whole step to the last nu, without elimination of unknowns.

        It is slower than `_Cones.nearer`. But the matrix stays regular for small nu, so that derivatives
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
        balance and sum, then those of the multipliers by contact. Then come sum a_i s_i0, and x_i o
        s_i. Of the last, the first number comes first, then the others, by contact.
        """
        n = self.normals[..., None]  # (b, f, 3, 1)
        mu = at.friction[:, None, None, None]
        push = -dot(at.forces, self.normals)[..., None, None]
        tangential = at.forces[..., None] + push * n
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


def _sum(x: Float[Tensor, "*a b"], axis: int) -> Float[Tensor, "*c b"]:
    """Return sums over a short axis, term by term. The order of a longer sum of torch depends on
    the number of contact sets.
    """
    return functools.reduce(torch.add, x.unbind(axis))


def _by_row(products: Float[Tensor, "*r 3 f b"]) -> Float[Tensor, "*r b"]:
    """Return sums over contacts and their axes."""
    return _sum(products.sum(-3), -2)


def _products(
    first: Float[Tensor, "m 3 f b"], second: Float[Tensor, "k 3 f b"]
) -> Float[Tensor, "m k b"]:
    """Return the product of each row of the one with each row of the other."""
    terms = zip(first.flatten(1, 2).unbind(1), second.flatten(1, 2).unbind(1), strict=True)
    total = first.new_zeros(len(first), len(second), first.shape[-1])
    for x, y in terms:
        total.addcmul_(x[:, None], y)
    return total


def _solved(
    matrix: Float[Tensor, "m m b"], right: Float[Tensor, "m k b"]
) -> Float[Tensor, "m k b"]:
    """Return the solutions of the linear equations of b contact sets, for k right sides."""
    solved, _ = torch.linalg.solve_ex(matrix.permute(2, 0, 1), right.permute(2, 0, 1))
    return solved.permute(1, 2, 0).contiguous()


def _by_contact(*blocks: Float[Tensor, "b f r _"]) -> Float[Tensor, "b m q"]:
    """Return the rows of equations that stand for each contact. They are its blocks for forces,
    press and slide on the diagonals, then that of the common friction.
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
