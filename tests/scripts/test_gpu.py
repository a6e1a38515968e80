"""The comparison of a GPU with the CPU counts and compares what it says it does."""

from pathlib import Path

import pytest
import torch

from torchgrasp.values import Contacts

SCRIPTS = str(Path(__file__).resolve().parents[1].parent / "scripts")


@pytest.fixture(autouse=True)
def _scripts(monkeypatch):
    monkeypatch.syspath_prepend(SCRIPTS)


def test_without_a_gpu_it_says_so(monkeypatch, capsys, tmp_path):
    from benchmarks.gpu.suite import gpu

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    gpu(out=tmp_path / "gpu.json")
    assert capsys.readouterr().out == "no GPU here\n"
    assert not (tmp_path / "gpu.json").exists()


def test_the_relative_error_is_of_the_worst_tensor():
    from benchmarks.gpu.compare import relative_error

    points = torch.ones(2, 3, 3, dtype=torch.float64)
    one, other = Contacts(points, points), Contacts(points, points.clone())
    other.normals[1, 2, 0] += 1e-3
    assert relative_error(one, one) == 0.0
    assert relative_error(one, other) == pytest.approx(1e-3)
    assert relative_error([torch.tensor([torch.nan])], [torch.tensor([1.0])]) == float("inf")


def test_the_size_at_which_it_overtakes_is_the_least_above_which_it_always_is_faster():
    from benchmarks.gpu.compare import Timing, overtakes

    def timings(*gpu: float) -> list:
        return [Timing(10**k, {1: 1.0}, seconds, 0.0, 0.0) for k, seconds in enumerate(gpu)]

    assert overtakes(timings(2.0, 0.5, 0.5), 1) == 10
    assert overtakes(timings(0.5, 2.0, 0.5), 1) == 100
    assert overtakes(timings(0.5, 0.5, 2.0), 1) is None


def test_a_kernel_is_compared_with_itself():
    from benchmarks.gpu.compare import Kernel, compare

    kernel = Kernel("square", "numbers", (4,), lambda n: (torch.square, (torch.arange(float(n)),)), 0.0)
    timing = compare(kernel, 4, torch.device("cpu"), (torch.get_num_threads(),))
    assert timing.error == 0.0 and timing.gpu > 0.0 and timing.size == 4
