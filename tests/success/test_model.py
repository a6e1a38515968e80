"""The model of success: trees as scikit-learn evaluates them, intervals as NumPy, and a shipped
model that is sound.
"""

import numpy as np
import pytest
import torch

pytest.importorskip("sklearn")

from sklearn.ensemble import HistGradientBoostingClassifier
from train.success import directions, read_trees

from tests.make import near
from tests.success.scenes import stump
from torchgrasp.success.features import FEATURES
from torchgrasp.success.model import load_success_model


@pytest.fixture(scope="module")
def boosted():
    """Trees of scikit-learn fitted to a curved edge and whole numbers, and rows to judge them on."""
    draw = np.random.default_rng(0)
    rows = np.c_[draw.normal(size=(1500, 4)), draw.integers(0, 4, size=1500)]
    passed = rows[:, 0] ** 2 + rows[:, 1] * rows[:, 4] + draw.normal(size=1500) > 0.7
    trees = HistGradientBoostingClassifier(max_iter=25, max_leaf_nodes=9, random_state=0).fit(
        rows[:1000], passed[:1000]
    )
    return trees, rows


def test_trees_give_the_log_odds_of_scikit_learn_also_at_their_thresholds(boosted):
    trees, rows = boosted
    model = read_trees(trees)
    near(
        model.log_odds(torch.from_numpy(rows)),
        torch.from_numpy(trees.decision_function(rows)),
        1e-9,
    )
    at = np.repeat(rows[:1], model.threshold.numel(), 0)
    for k, (feature, threshold) in enumerate(
        zip(model.feature.flatten().tolist(), model.threshold.flatten().tolist(), strict=True)
    ):
        at[k, feature] = threshold
    near(model.log_odds(torch.from_numpy(at)), torch.from_numpy(trees.decision_function(at)), 1e-9)
    assert model.log_odds(torch.zeros(0, 5, dtype=torch.float64)).shape == (0,)


def test_the_depth_is_that_of_the_deepest_leaf(boosted):
    trees, _ = boosted
    assert read_trees(trees).depth == max(
        int(tree[0].nodes["depth"].max()) for tree in trees._predictors
    )
    assert stump("mass", 0.5, 1.0, -1.0).depth == 1


def test_features_in_float32_are_read_as_they_are(boosted):
    trees, rows = boosted
    rounded = torch.from_numpy(rows).to(torch.float32)
    found = read_trees(trees).log_odds(rounded)
    assert found.dtype == torch.float64
    near(found, torch.from_numpy(trees.decision_function(rounded.double().numpy())), 1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_interval_is_interpolated_as_by_numpy_and_flat_beyond_the_ends(dtype):
    model = stump("mass", 0.5, 1.0, -1.0)
    odds = torch.linspace(-9, 9, 24, dtype=dtype).view(2, 4, 3).mT
    found = model.interval(odds)
    bands = model.bands.numpy()
    for side in (0, 1):
        wanted = np.interp(odds.numpy(), bands[:, 0], bands[:, side + 1])
        near(found[..., side].double(), torch.from_numpy(wanted), 1e-6)
    assert model.interval(odds[:0]).shape == (0, 3, 4, 2)


def draw_features(model, rows, generator):
    """Rows of features, each drawn among values between which the trees tell, and beyond."""
    inner = model.children[..., 0] != model.children[..., 1]
    columns = []
    for k in range(len(FEATURES)):
        at = model.threshold[inner & (model.feature == k)].unique()
        edges = (
            torch.cat([at[:1] - 1, at, at[-1:] + 1])
            if len(at)
            else torch.tensor([0.0, 1.0], dtype=torch.float64)
        )
        middles = (edges[1:] + edges[:-1]) / 2
        columns.append(middles[torch.randint(len(middles), (rows,), generator=generator)])
    return torch.stack(columns, -1)


@pytest.mark.parametrize("name", directions())
def test_the_shipped_model_never_errs_in_the_direction_of_a_feature(name, generator):
    model = load_success_model()
    column = FEATURES.index(name)
    less = draw_features(model, 4000, generator)
    other = draw_features(model, 4000, generator)
    more = less.clone()
    more[:, column] = torch.maximum(less[:, column], other[:, column])
    change = directions()[name] * (model.log_odds(more) - model.log_odds(less))
    assert float(change.min()) > -1e-9


def test_the_shipped_model_reads_the_task(generator):
    """A test of directions alone would pass a model that says nothing."""
    model = load_success_model()
    column = FEATURES.index("force to spare")
    less = draw_features(model, 4000, generator)
    other = draw_features(model, 4000, generator)
    more = less.clone()
    more[:, column] = torch.maximum(less[:, column], other[:, column])
    assert float((model.log_odds(more) - model.log_odds(less)).mean()) > 0


def test_the_shipped_model_is_of_these_features_and_its_numbers_fit_together():
    model = load_success_model()
    assert model.range.shape == (len(FEATURES), 2) and model.usual.shape == (len(FEATURES),)
    assert bool(((model.range[:, 0] <= model.usual) & (model.usual <= model.range[:, 1])).all())
    assert bool(((model.feature >= 0) & (model.feature < len(FEATURES))).all())
    nodes = torch.arange(model.feature.shape[1])[:, None]
    leaf = (model.children == nodes).all(-1)
    assert bool(
        ((model.children > nodes) | leaf[..., None]).all()
    )  # so that every walk ends at a leaf
    assert bool((model.value[~leaf] == 0).all())
    at, low, high = model.bands.T
    assert (
        bool((at.diff() > 0).all())
        and bool((low.diff() >= 0).all())
        and bool((high.diff() >= 0).all())
    )
    assert bool(((low >= 0) & (low <= high) & (high <= 1)).all())
    assert set(model.kept[:, 1].tolist()) <= {0.0, 1.0}
    assert all(
        x.dtype in (torch.float64, torch.int64)
        for x in vars(model).values()
        if isinstance(x, torch.Tensor)
    )
