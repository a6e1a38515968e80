"""The quick check of annotations finds what jaxtyping finds."""

import itertools

import pytest
import torch
from jaxtyping import Bool, Float, Int, Shaped
from jaxtyping._storage import get_shape_memo, pop_shape_memo, push_shape_memo
from torch import Tensor

from tests.annotations import instance_by_jaxtyping, is_instance, jaxtyped

AXES = "", "3", "n", "n 3", "3 n", "n n", "n m", "*b", "*b 3", "n *b", "3 *b n", "*b n n", "...", "_ n", "#n 3", "*#b n"
HINTS = [kind[Tensor, axes] for kind in (Float, Shaped) for axes in AXES] + [Int[Tensor, "n"], Bool[Tensor, "n 3"]]
SHAPES = [(), (1,), (2,), (3,), (2, 3), (3, 2), (3, 3), (2, 2), (1, 3), (2, 2, 3), (2, 3, 3), (3, 4, 2)]
VALUES = [torch.zeros(shape) for shape in SHAPES] + [torch.zeros(3, dtype=torch.int64), torch.zeros(2, 3) > 0, 3, None]


@pytest.mark.parametrize("first", HINTS, ids=lambda hint: f"{hint.dtype.__name__} {hint.dim_str}")
def test_two_values_after_one_another_are_found_to_fit_as_jaxtyping_finds_them(first):
    fits = set()
    for second, one, other in itertools.product(HINTS[:: len(AXES) // 2 + 3], VALUES, VALUES):
        found = []
        for check in (is_instance, instance_by_jaxtyping):
            push_shape_memo({})
            found.append((check(first, one), check(second, other), *get_shape_memo()[:2]))
            pop_shape_memo()
        assert found[0] == found[1], (first, second, one, other)
        fits.add(found[0][:2])
    assert len(fits) == 4 if first.dim_str != "..." else len(fits) > 1


def test_each_call_of_a_nested_function_is_checked():
    """As is a call that names what is defined later, and the result; letters are those of one call."""
    checked = jaxtyped(typechecker=None)

    def make(step):
        @checked
        def add(x: 'Float[Tensor, "n"]', y: "Later" = None, *, z: 'Float[Tensor, "n"] | None' = None) -> Tensor:
            return x + step if step else 0

        return add

    one, two, none = make(1), make(2), make(0)
    for n in (2, 3):
        assert one(torch.zeros(n)).sum() == n and two(torch.zeros(n), z=torch.ones(n)).sum() == 2 * n
    for call in (
        lambda: one(torch.zeros(2, 2)),
        lambda: two(torch.zeros(2), z=torch.zeros(3)),
        lambda: two(torch.zeros(2), y=3),
        lambda: none(torch.zeros(2)),
    ):
        with pytest.raises(TypeError):
            call()


Later = str | None


def test_the_library_is_checked_in_this_way():
    from torchgrasp.geometry.frames import rigid

    assert rigid(torch.eye(3), torch.zeros(3)).shape == (4, 4)
    with pytest.raises(TypeError):
        rigid(torch.eye(3)[None], torch.zeros(3))  # torch raises another error
