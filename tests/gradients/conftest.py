"""Derivatives are those of any number of samples."""

import dataclasses

import pytest

from torchgrasp.contacts import hold_probability


@pytest.fixture(autouse=True)
def few_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sample the errors of `hold_probability`, of which each sample costs the same, few times."""
    few = dataclasses.replace(hold_probability.HOLD, points=8)
    monkeypatch.setattr(hold_probability, "HOLD", few)
