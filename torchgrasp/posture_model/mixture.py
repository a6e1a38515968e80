"""The learned posture model of a hand: a Gaussian mixture over joints and contact codes (Eqs.
15-23).

A contact code q = (L, N) describes contacts by numbers that no rigid motion changes. The energy of
a code is half its squared Mahalanobis distance from the nearest component.
"""

import dataclasses
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.files import load_tensors, save_tensors
from torchgrasp.foundation.base import check_whole
from torchgrasp.foundation.checks import check_tensor, checked
from torchgrasp.foundation.errors import BadArgument, ModelFileError, Status
from torchgrasp.foundation.rules import ANY, Count, is_known
from torchgrasp.geometry.frames import degenerate, real, virtual_frame
from torchgrasp.geometry.linalg import UNIT_TOLERANCE, dot, norm
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import find_hand
from torchgrasp.posture_model.gaussian import PARAMETERS, GaussianMixture, map_rows, of_parameters
from torchgrasp.values.planning import ContactCode, Contacts

PERMUTATIONS: tuple[tuple[int, int, int], ...] = tuple(itertools.permutations(range(3)))  # pyright: ignore[reportAssignmentType]
"""The six assignments of three contacts to three fingers: in assignment k, finger i touches contact
`PERMUTATIONS[k][i]`.
"""
# the numbers of a contact code q = (L, N): three lengths [m], three cosines
CODE_NAMES = ("L1", "L2", "L3", "N1", "N2", "N3")
PAPER_ENERGY = 2.0
"""The paper's greatest mixture energy f_i (no unit), Eq. (21), of a code that the hand reaches."""
DEFAULT_ENERGY = 6.295793622
"""The default greatest energy (no unit) of a code that the hand reaches. It is half the 95 %
quantile of chi-square with 6 degrees of freedom.
"""
# positions, as shares of the joints' ranges, in the postures that identify a hand
PROBED = (0.2, 0.5, 0.7)
WIDEST = 1.0  # greatest mean distance [m] of a fingertip from the centroid: no hand is wider
WRITTEN = 1e-5  # greatest difference [m, or a cosine] of codes written with seven decimals


def encode_fingertips(
    points: Float[Tensor, "*b f 3"], normals: Float[Tensor, "*b f 3"]
) -> Float[Tensor, "*b q"]:
    """Return the contact code q = (L, N) of f points [m] with unit normals, Eq. (18) of the paper.

    L_i is the distance [m] of point i from the points' centroid. N holds the cosines n1.n2, n1.n3,
    n2.n3 and so on of all pairs of normals. So the code has f + f (f - 1) / 2 numbers. No rigid
    motion changes it. Fingertips with outward normals have the code of the contacts that they
    touch. Mirror images have this code too: check every match.
    """
    lengths = norm(points - points.mean(-2, keepdim=True))
    pairs = itertools.combinations(normals.unbind(-2), 2)
    cosines = torch.stack([dot(n, m) for n, m in pairs], dim=-1)
    return torch.cat([lengths, cosines], dim=-1)


@checked(gradients=True)
def encode(contacts: Contacts | tuple[Tensor, Tensor]) -> ContactCode:
    """Return the contact code of each of b contact triples, for all six assignments to fingers,
    Eqs. (15)-(18) of the paper.

    A code is six numbers that no rigid motion changes. They are the distances [m] of the three
    contacts from their centroid, and the cosines between their normals. The returned `ContactCode`
    has the codes `q` (b, 6, 6). It also has the frame of each triple (`obj_from_vf`) and a
    `status`. Codes and frames are differentiable in points and normals.

    Args:
        contacts: `Contacts` with three contacts in each set, or a pair of points [m] and unit
            normals, both (b, 3, 3).

    A triple whose contacts lie on a line has NaN and `Status.DEGENERATE`. Raises `BadArgument` for
    wrong shapes, numbers that are not finite, or normals whose length is not 1 within 1e-3.

    >>> encode((torch.eye(3)[None], torch.eye(3)[None])).q.shape
    torch.Size([1, 6, 6])
    """
    if isinstance(contacts, Contacts):
        contacts = contacts.points, contacts.normals
    points, normals = contacts
    check_tensor("points", points, (None, 3, 3))
    check_tensor("normals", normals, (len(points), 3, 3))
    lengths = norm(normals)
    error = (lengths - 1).abs()
    if is_known(lengths) and bool((error > UNIT_TOLERANCE).any()):
        worst = lengths.flatten()[error.argmax()].item()
        raise BadArgument("normals", f"a normal of length {worst:.6g}", "unit vectors")
    order = torch.tensor(PERMUTATIONS, device=points.device)
    # (b, 6, 3, 3)
    ordered_points = points[:, order]
    ordered_normals = normals[:, order]
    # in any order: at the threshold rounding may distinguish them
    flat = degenerate(ordered_points).any(1)
    bad = flat[:, None, None]
    # A degenerate row gets another triangle, so that one call frames all rows.
    other = torch.eye(3, device="cpu").to(points)
    ordered_points = torch.where(bad[..., None], other, ordered_points)
    return ContactCode(
        q=torch.where(bad, torch.nan, encode_fingertips(ordered_points, ordered_normals)),
        obj_from_vf=torch.where(bad[..., None], torch.nan, virtual_frame(ordered_points)),
        status=torch.where(flat, int(Status.DEGENERATE), int(Status.OK)),
        permutation=order,
    )


def describe_compatibility(hand: Hand) -> dict[str, str]:
    """Return texts by name that identify a hand, for the metadata of its sampled postures and its
    posture model.

    They are the hand's name, its grasping fingers, a hash of its files, and the contact codes of
    three postures. The postures depend on the joint limits alone.
    """
    codes = " ".join(f"{x:.7f}" for x in _probe_codes(hand).flatten().tolist())
    return {
        "hand": hand.name,
        "fingers": hand.source.option,
        "hand_sha256": hand.source.sha256,
        "hand_codes": codes,
    }


def check_compatible(meta: dict[str, str], joint_names: tuple[str, ...], hand: Hand) -> None:
    """Raise `BadArgument` unless a posture model belongs to a hand: same joint names, grasping
    fingers, joint limits and fingertips.

    `meta` and `joint_names` are those of the model. Without "hand_codes" in `meta`, only the names
    of the joints are compared.
    """
    if joint_names != hand.joint_names:
        raise BadArgument(
            "mixture", f"joints {joint_names}", f"the joints {hand.joint_names} of the hand"
        )
    if "hand_codes" not in meta:
        return
    ours = _probe_codes(hand).flatten()
    try:
        theirs = real([float(x) for x in meta["hand_codes"].split()])
    except ValueError as error:
        raise BadArgument("mixture", f"hand_codes {meta['hand_codes']!r}", "numbers") from error
    same = theirs.shape == ours.shape and torch.allclose(
        theirs.to(ours), ours, rtol=0, atol=WRITTEN
    )
    if not same:
        whose = f"hand {meta.get('hand')!r}, fingers {meta.get('fingers')!r}"
        allowed = f"one of {hand.name!r}, {hand.source.option!r}: train it anew"
        found = f"a model of {whose}, of other limits or fingertips"
        raise BadArgument("mixture", found, allowed)


def _probe_codes(hand: Hand) -> Float[Tensor, "3 q"]:
    """Return the contact codes of three fixed postures, Eqs. (15)-(18) of the paper; they identify
    the hand.
    """
    lower = hand.lower.double()
    upper = hand.upper.double()
    share = real(PROBED).to(lower.device)
    joint = torch.arange(hand.dof, device="cpu")
    index = (joint + torch.arange(3, device="cpu")[:, None]) % 3  # (3, h)
    return encode_fingertips(*hand.fingertips(lower + share[index] * (upper - lower)))


@checked
@dataclasses.dataclass(frozen=True)
class GraspMixture(GaussianMixture):
    """The learned posture model of a hand: a mixture over its joints and contact codes (Eqs. 19-20
    of the paper).

    `load_mixture` reads it, and `fit_mixture` fits it. `energy` tells whether the hand reaches
    contacts of a given code. `joints` returns the joints that it then most likely has.

    Its d dimensions are the h joints [rad or m], in the hand's order, then a contact code. A code
    has the distances L1 L2 L3 [m] of three contacts from their centroid. Then come the cosines N1
    N2 N3 between their normals. A contact set has six codes, one for each assignment to fingers
    (`encode`).

    Args:
        weights: probabilities (m,) of the m components, of sum 1.
        means: means (m, d) of the components, in the units of the dimensions.
        covariances: covariances (m, d, d) of the components, in products of these units.
        names: names of the d dimensions; the last six are `CODE_NAMES`.
        regularisation: variance that the fit added to every dimension, relative to the samples'
            variance.
        meta: texts that describe hand, samples and fit.

    Raises `BadArgument` if the last `names` are not `CODE_NAMES`, or for weights or covariances
    that no mixture has (`GaussianMixture`).

    >>> from torchgrasp import encode
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> model, code = load_mixture("barrett"), encode(load_shipped_grasp("jug", "barrett").contacts)
    >>> model.energy(code).shape, model.joints(code).shape, model.modes(code.q, k=2)[0].shape
    (torch.Size([1, 6]), torch.Size([1, 6, 4]), torch.Size([1, 6, 2, 4]))
    """

    regularisation: float = 0.0
    meta: dict[str, str] = dataclasses.field(default_factory=dict[str, str])

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.names[-6:] != CODE_NAMES or len(self.names) < 7:
            allowed = f"the joints' names, then {', '.join(CODE_NAMES)}"
            raise BadArgument("names", self.names, allowed)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The names of the h joints, in the order of the hand."""
        return self.names[:-6]

    @of_parameters
    def _code(self) -> GaussianMixture:
        """The mixture over the contact code alone, without the joints, Eq. (22) of the paper."""
        return self.marginal(CODE_NAMES)

    @of_parameters
    def _regression(self) -> Float[Tensor, "m h 6"]:
        """The slope of each component's mean joints over the contact code: Sigma_(Theta,q)
        Sigma_q^-1 in Eq. (23).
        """
        whitening = self._code.whitening.matrix
        return self.covariances[:, :-6, -6:].double() @ whitening.mT @ whitening

    @of_parameters
    def _stacked_regression(self) -> Float[Tensor, "k h"]:
        """Matrices, stacked over components, that multiply (q, 1) to give each component's mean
        joints at a code q.
        """
        slope = self._regression
        at_zero = self.means[:, :-6].double() - (slope @ self.means[:, -6:, None].double())[..., 0]
        return torch.cat([slope.transpose(1, 2), at_zero[:, None]], 1).flatten(0, 1)

    @checked(gradients=True)
    def energy(
        self, code: ContactCode | Annotated[Float[Tensor, "*b 6"], ANY]
    ) -> Float[Tensor, "*b"]:
        """Return the energy (*b,) (no unit) of each contact code, Eq. (21). A low one means that
        the hand reaches it.

        It is half the squared Mahalanobis distance of the code from the nearest component. The hand
        probably reaches a code whose energy is below 6.3 (`DEFAULT_ENERGY`). The paper's bound is 2
        (`PAPER_ENERGY`). Where two components are equally near, the derivative is the mean of both
        derivatives.

        Args:
            code: codes (*b, 6): three lengths [m], then three cosines. b stands for any batch axes.
                A `ContactCode` counts as its `q` (b, 6, 6); the result is then (b, 6). Its second
                axis counts the six assignments of the contacts to the fingers
                (`ContactCode.permutation`). A code that is not finite gives NaN.

        Raises `BadArgument` for codes that do not have six numbers.
        """
        whitening = self._code.whitening
        return _map_codes(lambda q: 0.5 * whitening.squared(q).amin(-1), code)

    @checked(gradients=True)
    def joints(
        self, code: ContactCode | Annotated[Float[Tensor, "*b 6"], ANY]
    ) -> Float[Tensor, "*b h"]:
        """Return the expected positions (*b, h) [rad or m] of the joints, given each contact code,
        Eq. (23) of the paper.

        They may exceed the joint limits.

        Args:
            code: codes (*b, 6): three lengths [m], then three cosines. b stands for any batch axes.
                A `ContactCode` counts as its `q` (b, 6, 6); the result is then (b, 6, h). Its
                second axis counts the six assignments of the contacts to the fingers
                (`ContactCode.permutation`). A code that is not finite gives NaN.

        Raises `BadArgument` for codes that do not have six numbers.
        """
        codes = self._code
        regression = self._stacked_regression

        def expect(q: Float[Tensor, "n 6"]) -> Float[Tensor, "n h"]:
            # sum_i h_i A_i (q, 1) as one matrix product
            extended = torch.cat([q, torch.ones_like(q[:, :1])], 1)
            weighted = torch.softmax(codes.log_joint(q), -1)[:, :, None] * extended[:, None]
            return weighted.flatten(1) @ regression

        return _map_codes(expect, code)

    @checked(gradients=True)
    def modes(
        self, q: Annotated[Float[Tensor, "*b 6"], ANY], k: Count
    ) -> tuple[Float[Tensor, "*b k h"], Float[Tensor, "*b k"]]:
        """Return (joints, responsibilities) of the k components that most likely produced each
        contact code.

        `joints` (*b, k, h) [rad or m] are each component's mean given the code. `responsibilities`
        (*b, k) are the components' probabilities given the code, h_i in Eq. (23) of the paper, the
        largest first. Use `modes` where several postures have the same code. The mean that `joints`
        returns may then be none of these postures.

        Args:
            q: codes (*b, 6): three lengths [m], then three cosines. b stands for any batch axes. A
                code that is not finite gives NaN.
            k: number of components, 1 to m.

        Raises `BadArgument` for k outside [1, m], or for codes that do not have six numbers.
        """
        check_whole("k", k, 1, len(self.weights))
        codes = self._code
        regression = self._regression

        def take(q: Float[Tensor, "n 6"]) -> Float[Tensor, "n k d"]:
            top = torch.log_softmax(codes.log_joint(q), -1).topk(k, dim=-1)  # free of underflow
            # the bracket of Eq. (23), the mean of the joints given the code in each component
            difference = q[:, None] - self.means[:, -6:].double()
            turned = torch.einsum("mhc,nmc->nmh", regression, difference)
            means = self.means[:, :-6].double() + turned
            index = top.indices[..., None].expand(-1, -1, len(self.joint_names))
            return torch.cat([means.gather(-2, index), top.values.exp()[..., None]], -1)

        modes = _map_codes(take, q)
        return modes[..., :-1], modes[..., -1]

    @checked
    def save(self, path: Path | str) -> Path:
        """Write the mixture to a safetensors file, atomically, for `load_mixture`; return the path.

        Raises `OutputError` if the file cannot be written.

        >>> import tempfile
        >>> file = load_mixture("barrett").save(Path(tempfile.mkdtemp(), "mixture.safetensors"))
        >>> load_mixture(file).joint_names
        ('spread', 'f1_flex', 'f2_flex', 'f3_flex')
        """
        tensors = {name: getattr(self, name).detach() for name in PARAMETERS}
        meta = self.meta | {"names": " ".join(self.names)}
        meta |= {"regularisation": repr(self.regularisation)}
        return save_tensors(path, "mixture", tensors, meta)


def _map_codes(
    function: Callable[[Float[Tensor, "n 6"]], Tensor], code: ContactCode | Tensor
) -> Tensor:
    """Apply a function to all codes q; a code that is not finite gives NaN.

    Such a code spoils no gradient.
    """
    q = code.q if isinstance(code, ContactCode) else code
    if q.ndim < 1 or q.shape[-1] != 6:
        raise BadArgument("code", f"shape {tuple(q.shape)}", "rows of 6 numbers, L and N")
    bad = ~torch.isfinite(q).all(-1)
    y = map_rows(function, torch.where(bad[..., None], 0.0, q))
    return torch.where(bad.view(bad.shape + (1,) * (y.ndim - bad.ndim)), torch.nan, y)


def check_mixture(mixture: GraspMixture, hand: Hand) -> None:
    """Raise `BadArgument` unless a posture model belongs to a hand (`check_compatible`), and has
    its units.

    The mean joints must be within the hand's limits, and the mean distances of the fingertips from
    their centroid within 1 m (`WIDEST`). Otherwise the postures of the training had other units,
    and no contacts seem to be within reach.
    """
    check_compatible(mixture.meta, mixture.joint_names, hand)
    mean = mixture.mean().detach().to(hand.lower.device)
    joints, lengths, _ = mean.split([hand.dof, 3, 3])
    if bool(((joints < hand.lower) | (joints > hand.upper)).any()):
        found = f"mean joints {[round(x, 3) for x in joints.tolist()]}"
        raise BadArgument("mixture", found, "joints within the hand's limits, in radians or metres")
    if not bool(((lengths > 0) & (lengths < WIDEST)).all()):
        found = f"mean distances {[round(x, 3) for x in lengths.tolist()]} of the fingertips"
        raise BadArgument("mixture", found, f"distances up to {WIDEST:g} m, in metres")


@checked
def load_mixture(name_or_path: Path | str) -> GraspMixture:
    """Return the learned posture model of a hand, read from a file.

    Args:
        name_or_path: name of a shipped hand, or folder of another hand, which holds a
            mixture.safetensors. Or the path of a .safetensors file that `GraspMixture.save` wrote.

    Raises `HandFileError` for an unknown hand, and `ModelFileError` for a missing or malformed
    file.

    >>> load_mixture("allegro").means.shape
    torch.Size([40, 18])
    """
    path = mixture_path(name_or_path)
    tensors, meta = load_tensors(path, "mixture", set(PARAMETERS))
    types = [str(t.dtype) for t in tensors.values()]
    if any(t.dtype != torch.float64 for t in tensors.values()):
        raise ModelFileError("path", f"{path}: {types}", "float64 tensors")
    try:
        names = tuple(meta.pop("names").split())
        regularisation = float(meta.pop("regularisation"))
        return GraspMixture(**tensors, names=names, regularisation=regularisation, meta=meta)
    except (KeyError, AttributeError, TypeError, ValueError) as error:
        allowed = "a mixture that GraspMixture.save wrote"
        raise ModelFileError("path", f"{path}: {error}", allowed) from error


def mixture_path(name_or_path: Path | str) -> Path:
    """Return the path of the file of a posture model, given this path, or a hand's name or folder.

    The path of a .safetensors file is returned unchanged. For a hand's name or folder, the result
    is the path of mixture.safetensors in the hand's folder. The file need not exist.
    """
    if Path(name_or_path).suffix == ".safetensors":
        return Path(name_or_path)
    return find_hand(name_or_path) / "mixture.safetensors"
