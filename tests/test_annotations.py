"""The check of annotations that tests add to each function."""

from collections.abc import Iterator

import pytest
import torch
from beartype import beartype
from jaxtyping import Float, TypeCheckError
from torch import Tensor

from tests.annotations import CALLS, check_anew, jaxtyped
from torchgrasp.geometry.linalg import limit_norm, solve_least_squares


def test_each_call_of_a_nested_function_is_checked():
    """As is a call that names what is defined later, and the result; letters are those of one call."""
    checked = jaxtyped(typechecker=None)

    def make(step):
        @checked
        def add(
            x: 'Float[Tensor, "n"]', y: "Later" = None, *, z: 'Float[Tensor, "n"] | None' = None
        ) -> Tensor:
            return x + step if step else 0

        return add

    one = make(1)
    two = make(2)
    none = make(0)
    for n in (2, 3):
        check_anew()
        assert (
            one(torch.zeros(n)).sum() == n and two(torch.zeros(n), z=torch.ones(n)).sum() == 2 * n
        )
    for call in (
        lambda: one(torch.zeros(2, 2)),
        lambda: two(torch.zeros(2), z=torch.zeros(3)),
        lambda: two(torch.zeros(2), y=3),
        lambda: none(torch.zeros(2)),
    ):
        check_anew()
        with pytest.raises(TypeError):
            call()


@pytest.mark.parametrize("yields", [False, True])
def test_the_first_calls_of_each_test_are_checked(yields):
    """However often other tests have called the function; the calls of a test are few."""

    @jaxtyped(typechecker=beartype)
    def of_one(x: 'Float[Tensor, "n"]') -> list[Tensor]:
        return [x]

    @jaxtyped(typechecker=beartype)
    def each_of_one(x: 'Float[Tensor, "n"]') -> Iterator[Tensor]:
        yield x

    checked = each_of_one if yields else of_one
    for _ in range(CALLS):
        with pytest.raises((TypeError, TypeCheckError)):
            checked(torch.zeros(2, 2))
    assert [x.shape for x in checked(torch.zeros(2, 2))] == [(2, 2)]
    check_anew()  # as conftest.py does before each test
    with pytest.raises((TypeError, TypeCheckError)):
        checked(torch.zeros(2, 2))


Later = str | None


def test_the_library_is_checked_in_this_way():
    from torchgrasp.geometry.frames import rigid

    assert rigid(torch.eye(3), torch.zeros(3)).shape == (4, 4)
    with pytest.raises(TypeError):
        rigid(torch.eye(3)[None], torch.zeros(3))  # torch raises another error


ROWS = torch.ones(4, 2, dtype=torch.float64)
VALUES = torch.ones(4, dtype=torch.float64)


@pytest.mark.parametrize(
    "arguments",
    [(VALUES, VALUES), (ROWS, VALUES[:3]), (ROWS.long(), VALUES)],
    ids=["rank", "letter", "type"],
)
def test_tests_check_annotations_of_tensors(arguments):
    with pytest.raises(TypeError):
        solve_least_squares(*arguments)


def test_tests_check_annotations_and_let_right_arguments_pass():
    assert solve_least_squares(torch.rand(4, 2).double(), VALUES).shape == (2,)
    with pytest.raises(TypeError):
        limit_norm(ROWS, "1")  # pyright: ignore[reportArgumentType]
