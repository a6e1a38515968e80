"""Public calls bound torch's threads to one, and restore them."""

import pytest
import torch

import torchgrasp
from torchgrasp.foundation.threads import one_thread, single_threaded
from torchgrasp.shape import Kernel


@pytest.fixture(autouse=True)
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_a_fit_uses_one_thread_and_restores_the_threads():
    seen = set()

    def profile(r):
        seen.add(torch.get_num_threads())
        return 1 / (1 + r * r)

    torchgrasp.fit_shape(torchgrasp.load_object("cylinder").view, kernel=Kernel(profile), budget=30)
    assert seen == {1} and torch.get_num_threads() == 2


def test_a_plan_uses_one_thread_in_what_its_observer_sees():
    seen = set()
    view = torchgrasp.load_object("cylinder").view
    hand = torchgrasp.load_hand("barrett")
    torchgrasp.plan_grasps(
        view, hand, starts=20, observer=lambda *_: seen.add(torch.get_num_threads())
    )
    assert seen == {1} and torch.get_num_threads() == 2


def test_threads_are_restored_by_a_stream_between_its_items_and_when_it_is_abandoned():
    view = torchgrasp.load_object("cylinder").view
    hand = torchgrasp.load_hand("barrett")
    stream = torchgrasp.stream_grasps(view, hand, starts=20)
    assert len(next(stream)) and torch.get_num_threads() == 2
    del stream
    assert torch.get_num_threads() == 2


def test_threads_are_restored_after_an_error_and_by_the_outermost_call():
    @single_threaded
    def fail():
        assert torch.get_num_threads() == 1
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert torch.get_num_threads() == 2
    with one_thread(), pytest.raises(ZeroDivisionError):
        fail()
    with one_thread():
        single_threaded(lambda: None)()
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 2
