"""Each row of the table of gradients under every transform and setting, and the table beside the
public functions.
"""

import inspect
import pickle
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad, gradcheck, gradgradcheck
from torch.func import grad, hessian, jacfwd, jacrev, jvp, vmap

from tests.apart import run_apart
from tests.gradients.compare import F64, every, near, scalar, slopes, weighted_sum
from tests.gradients.table import LAW, MASKS, ROWS, Function, Row, draw, outputs, page
from tests.hostile.arguments import checked_things, required
from tests.settings import other_settings
from torchgrasp.foundation.base import Value, map_tensors, named_tensors
from torchgrasp.foundation.errors import BadArgument

ROOT = Path(__file__).parents[2]
STEP = 1e-6
THINGS = checked_things()
COMPILED = ("certify.certify", "GraspMixture.log_prob", "Hand.fingertips", "ShapeGP.predict")
"""One function of contacts, of a posture model, of a hand and of a shape."""


def check_backward(row: Row, f: Function, x: tuple[Tensor, ...]) -> None:
    """Reverse and forward mode agree with finite differences, and no derivative is zero everywhere."""
    leaves = tuple(v.clone().requires_grad_() for v in x)
    assert gradcheck(lambda *v: outputs(f(*v)), leaves, fast_mode=True, check_forward_ad=True)
    assert all(bool(v.any()) for v in slopes(f, x))


def check_double_backward(row: Row, f: Function, x: tuple[Tensor, ...]) -> None:
    leaves = tuple(v.clone().requires_grad_() for v in x)
    if row.order > 1:
        assert gradgradcheck(scalar(f), leaves, fast_mode=True)
        return
    first = torch.autograd.grad(scalar(f)(*leaves), leaves, create_graph=True)
    with pytest.raises(BadArgument, match="second derivative"):
        torch.autograd.grad(sum(v.sum() for v in first), leaves)


def check_jacobians(row: Row, f: Function, x: tuple[Tensor, ...]) -> None:
    one, other = (how(lambda *v: outputs(f(*v)), every(x))(*x) for how in (jacrev, jacfwd))
    near(one, other)


def check_hessian(row: Row, f: Function, x: tuple[Tensor, ...]) -> None:
    """Hessians are symmetric, and they are the finite differences of gradients."""
    if row.order < 2:
        for how in (
            hessian,
            lambda g: jacrev(jacrev(g)),
            lambda g: jacfwd(jacfwd(g)),
            lambda g: jacrev(jacfwd(g)),
        ):
            with pytest.raises(BadArgument, match="second derivative"):
                how(scalar(f))(*x)
        return
    found = hessian(scalar(f))(*x).reshape(x[0].numel(), x[0].numel())
    near(found, found.T)
    way = draw(*x[0].shape, seed=7)
    after, before = (grad(scalar(f))(x[0] + sign * STEP * way, *x[1:]) for sign in (1, -1))
    near((found @ way.flatten()).view_as(way), (after - before) / (2 * STEP), 1e-5)


def check_vmap(row: Row, f: Function, x: tuple[Tensor, ...]) -> None:
    """A call over an axis is a loop over it, and so are its gradients."""
    other = tuple(v + 1e-4 * draw(*v.shape, seed=3) for v in x)
    both = tuple(torch.stack(pair) for pair in zip(x, other, strict=True))
    total = scalar(f)
    near(
        vmap(lambda *v: outputs(f(*v)))(*both),
        tuple(map(torch.stack, zip(outputs(f(*x)), outputs(f(*other)), strict=True))),
    )
    loop = zip(grad(total, every(x))(*x), grad(total, every(x))(*other), strict=True)
    near(vmap(grad(total, every(x)))(*both), tuple(map(torch.stack, loop)))


def check_jvp(row: Row, f: Function, x: tuple[Tensor, ...]) -> None:
    way = tuple(draw(*v.shape, seed=5) for v in x)
    value, change = jvp(lambda *v: outputs(f(*v)), x, way)
    after, before = (
        outputs(f(*(v + sign * STEP * w for v, w in zip(x, way, strict=True)))) for sign in (1, -1)
    )
    near(value, outputs(f(*x)))
    near(change, tuple((a - b) / (2 * STEP) for a, b in zip(after, before, strict=True)), 1e-5)


def check_single(row: Row, f: Function, x: tuple[Tensor, ...]) -> None:
    """In single precision values and gradients are those of double precision."""
    single, y = row.make(torch.float32)
    near(tuple(v.double() for v in outputs(single(*y))), outputs(f(*x)), 2e-3)
    found = slopes(single, y)
    assert all(v.dtype == torch.float32 for v in found)
    for one, other in zip(found, slopes(f, x), strict=True):
        near(one.double(), other, 5e-3 * max(1.0, float(other.abs().max())))


def check_axes(row: Row, f: Function, x: tuple[Tensor, ...]) -> None:
    """More leading axes give the same rows."""
    if row.batched:
        k = row.batched
        found = outputs(f(*(torch.stack([v, v]) for v in x[:k]), *x[k:]))
        near(found, tuple(torch.stack([y, y]) for y in outputs(f(*x))))


def same(found: tuple[Tensor, ...], expected: tuple[Tensor, ...]) -> bool:
    """Tell whether tensors have the same dtypes and bits; NaN equals NaN."""
    pairs = zip(found, expected, strict=True)
    return all(a.dtype == b.dtype and torch.allclose(a, b, 0, 0, equal_nan=True) for a, b in pairs)


def check_settings(row: Row, f: Function, x: tuple[Tensor, ...]) -> None:
    """Under other settings of torch no bit changes; derivatives are taken after them."""
    public = row in ROWS.values()  # in single precision, which autocast rounds
    f, x = row.make(torch.float32 if public and "single" not in row.lacks else F64)
    leaves = tuple(v.clone().requires_grad_() for v in x)
    expected = outputs(f(*leaves))
    with other_settings():
        found = outputs(f(*leaves))
    assert same(found, expected)
    derivatives = torch.autograd.grad(weighted_sum(found), leaves)
    assert same(derivatives, torch.autograd.grad(weighted_sum(expected), leaves))
    with other_settings(), torch.inference_mode():
        found = outputs(f(*(v.clone() for v in x)))
    assert same(found, outputs(f(*x)))
    assert not public or not any(y.is_inference() for y in found)


def check_order_of_calls(row: Row, f: Function, x: tuple[Tensor, ...]) -> None:
    """What a first call keeps, in inference mode or inside a transform, spoils no later gradient."""
    expected = outputs(f(*x))
    expected_slopes = slopes(f, x)
    for first in (inferred, jacrev, jacfwd):
        fresh, y = row.make(F64)
        first(lambda *v, fresh=fresh: outputs(fresh(*v)))(*y)
        near(slopes(fresh, y), expected_slopes)
        near(outputs(fresh(*y)), expected)
        assert not any(v.requires_grad for v in outputs(fresh(*y)))
        owner = getattr(fresh, "__self__", None)
        if owner is not None:
            pickle.dumps(owner)


def inferred(function: Function) -> Function:
    def call(*x: Tensor) -> Any:
        with torch.inference_mode():
            return function(*x)

    return call


ALL = {**ROWS, **LAW}
ALIKE = re.compile(
    r"HollowShape\.(?!predict|mean$)|GraspMixture\.(log|marg|cond)|jet|joint_at|estimate|predict, "
).search
"""Finds rows that share most of their code with others: `--hypothesis-profile=long` tries them."""
CHECKS = {
    name.removeprefix("check_"): check
    for name, check in globals().items()
    if name.startswith("check_")
}


def cells() -> Iterator[tuple[str, str]]:
    """Yield the rows and checks that are tried; of rows that share their code, the derivatives
    alone.
    """
    for name in ALL:
        for check in CHECKS:
            if not ALIKE(name) or check in (
                "backward",
                "double_backward",
                "hessian",
                "vmap",
                "jvp",
            ):
                yield name, check


@pytest.mark.parametrize(("name", "check"), cells())
@pytest.mark.filterwarnings("ignore")  # torch warns of its own forward mode and compiler
def test_a_row_of_the_table(name: str, check: str, request: pytest.FixtureRequest):
    """Of rows that share their code the first derivatives alone are tried in a short run."""
    row = ALL[name]
    long = request.config.getoption("--hypothesis-profile") == "long"
    if ALIKE(name) and check != "backward" and not long:
        pytest.skip("its code is that of another row")
    if check in row.lacks:
        pytest.skip("the table says that it lacks this")
    CHECKS[check](row, *row.make(F64))


@pytest.mark.slow
def test_compiled_rows_are_the_same(request: pytest.FixtureRequest):
    """In a process of its own: the checks of annotations, which tests add to each function, cannot
    be compiled. `COMPILED` alone; `--hypothesis-profile=long` takes all.
    """
    alike = (
        "HollowShape",
        ".sample",
        ".joint",
        "distance_rows",
    )  # they share their code with `ShapeGP.predict`
    alike += (
        "SelfCollision",
        "log_joint",
        ".marginal",
    )  # and these with `Hand.self_clearance` and `log_prob`
    names = [name for name, row in ROWS.items() if "compile" not in row.lacks and not ALIKE(name)]
    names = [name for name in names if not any(part in name for part in alike)]
    if request.config.getoption("--hypothesis-profile") != "long":
        names = [name for name in names if name.endswith(COMPILED)]
    code = "import warnings; warnings.simplefilter('ignore'); "
    (said,) = run_apart(
        code + f"from tests.gradients.compare import compile_rows; compile_rows({names})"
    )
    assert said.split() == names


def test_the_table_has_public_functions_alone():
    assert {*ROWS, *MASKS} <= {*THINGS} and not {*ROWS} & {*MASKS}


def test_the_page_has_the_table():
    assert page() in (ROOT / "docs" / "gradients.md").read_text()


def has_numbers(value: Any) -> bool:
    """Return whether an argument has floating-point tensors, itself or inside."""
    if isinstance(value, Value):
        return any(x.is_floating_point() for x in named_tensors(value).values())
    parts = value if isinstance(value, tuple | list) else ()
    return value.is_floating_point() if isinstance(value, Tensor) else any(map(has_numbers, parts))


def changed(function: Function, value: Any) -> Any:
    """Return an argument with all its floating-point tensors replaced by those that a function
    returns.
    """
    if isinstance(value, tuple | list):
        parts = [changed(function, part) for part in value]
        return type(value)(*parts) if hasattr(value, "_fields") else type(value)(parts)
    if isinstance(value, Value):
        return map_tensors(lambda x: changed(function, x), value)
    return function(value) if isinstance(value, Tensor) and value.is_floating_point() else value


def refusing(call: Function, arguments: dict[str, Any], key: str) -> Iterator[tuple[str, Function]]:
    """Yield calls of a function with an argument by which derivatives are taken, in each way of
    torch.
    """

    def with_argument(function: Function) -> Any:
        try:
            argument = changed(function, arguments[key])
        except Exception as error:  # a value that cannot be made inside the transform
            raise BadArgument(key, "no value", "a value") from error
        return call(**arguments | {key: argument})

    def dual() -> Any:
        with forward_ad.dual_level():
            return with_argument(lambda x: forward_ad.make_dual(x, torch.ones_like(x)))

    shifted = lambda shift: with_argument(lambda x: x + shift.to(x))  # noqa: E731
    yield "requires grad", lambda: with_argument(lambda x: x.detach().clone().requires_grad_())
    yield "dual", dual
    for how in (grad, jacrev, jacfwd, hessian):
        yield how.__name__, lambda how=how: how(shifted)(torch.zeros((), device="cpu"))
    yield "vmap", lambda: vmap(shifted)(torch.zeros(2, device="cpu"))


REFUSING = sorted(
    {name for name, (_, thing) in THINGS.items() if not inspect.isclass(thing)} - {*ROWS, *MASKS}
)


@pytest.mark.parametrize("name", REFUSING)
@pytest.mark.filterwarnings("ignore")
def test_all_other_functions_refuse_tensors_by_which_derivatives_are_taken(
    name: str, tmp_path: Path
):
    make, annotated = THINGS[name]
    call = make()
    arguments = required(annotated, call, tmp_path)
    missed = []
    for key in (key for key, value in arguments.items() if has_numbers(value)):
        for how, attempt in refusing(call, arguments, key):
            try:
                attempt()
                missed.append(f"{key}, {how}: taken")
            except BadArgument as error:
                if not error.argument.startswith(key):
                    missed.append(f"{key}, {how}: {error}")
            except Exception as error:
                missed.append(f"{key}, {how}: {error!r}"[:200])
    assert not missed
