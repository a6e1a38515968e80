"""The pretended device breaks where a GPU's does."""

import pytest
import torch

from tests.devices.elsewhere import DEVICE, elsewhere, pretend


def test_it_says_where_it_is_and_results_stay_there():
    x = elsewhere(torch.arange(3.0))
    assert x.device == DEVICE and x.is_cuda
    assert (
        (2 * x).device == DEVICE
        and x[1:].sum().device == DEVICE
        and torch.zeros_like(x).device == DEVICE
    )
    assert x.cpu().device == torch.device("cpu") and not isinstance(x.cpu(), type(x))


@pytest.mark.promise("F8")
@pytest.mark.parametrize(
    "mix",
    [
        lambda x, y: x + y,
        lambda x, y: y @ x,
        lambda x, y: torch.cat([x, y]),
        lambda x, y: torch.where(y > 0, x, x),
        lambda x, y: y[(x > 0)],
        lambda x, y: x.index_select(0, y.long()),
        lambda x, y: x.__setitem__(slice(0, 3), y),
    ],
)
def test_a_mix_of_devices_is_an_error(mix):
    with pytest.raises(RuntimeError, match="same device"):
        mix(elsewhere(torch.ones(3)), torch.zeros(3))


def test_numpy_and_a_generator_of_the_cpu_are_errors():
    with pytest.raises(TypeError, match="numpy"):
        elsewhere(torch.ones(3)).numpy()
    with pytest.raises(RuntimeError, match="generator"), pretend():
        torch.randn(3, generator=torch.Generator(), device=DEVICE)


def test_numbers_of_the_cpu_and_its_indices_are_taken():
    x = elsewhere(torch.arange(3.0))
    assert float((x + torch.tensor(1.0)).sum()) == 6.0
    assert x[torch.tensor([0, 2])].tolist() == [0.0, 2.0]


def test_what_is_made_or_moved_there_is_there():
    with pretend():
        assert torch.zeros(2, device=DEVICE).device == DEVICE
        assert torch.ones(2).to(DEVICE).device == DEVICE
        assert torch.ones(2).to(elsewhere(torch.ones(1))).device == DEVICE
        assert torch.ones(2).device.type == "cpu"


def test_gradients_follow():
    x = elsewhere(torch.ones(3)).requires_grad_()
    gradient = torch.autograd.grad((x * x).sum(), x)[0]
    assert gradient.tolist() == [2.0, 2.0, 2.0]
