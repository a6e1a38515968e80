"""How fast and how large: queries against GPyTorch and against a matrix product, memory, raw clouds, growth."""

import multiprocessing
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.common import Row, least_seconds, peak_mib, random_view
from benchmarks.shape.exactness import NOISE, PSI_SCALE, observe, posterior, queries_in
from benchmarks.shape.gpytorch_peer import gpytorch_posterior, product_floor
from torchgrasp.shape.fit import condition
from torchgrasp.shape.values import Normalisation
from torchgrasp.values import PointCloud

CHUNKS = (30, 100, 300)
"""Queries that GPyTorch gets at once; its joint covariance of a chunk grows with the square."""
GROWTH = (30, 70, 150, 300, 600, 1000)


def bench_queries(n: int, least_ratio: float, queries: int) -> list[Row]:
    """Predict mean, normal and the full covariance (so all four variances) at many points, and let the peers do so.

    A covariance of more than 800 rows GPyTorch handles by conjugate gradients, unless it is told to factor it: both
    are measured, and the bar is for the one that its user gets.
    """
    shape = posterior(n)
    points = queries_in(shape, queries)
    predict, multiply = partial(shape.predict, points), product_floor(4 * n, 4 * queries)
    floor, ours = least_seconds(multiply), least_seconds(predict)
    theirs = time_gpytorch(n, points, dense=False)
    factored = time_gpytorch(n, points, dense=True) if 4 * n > 800 else theirs
    floor = min(floor, least_seconds(multiply)) / 2  # half: the factor is triangular
    ours = min(ours, least_seconds(predict))
    ratio = min(theirs.values()) / ours
    numbers = {"n": n, "seconds": ours, "floor_s": floor, "gpytorch_s": theirs, "gpytorch_factored_s": factored}
    told = f"; told to factor {min(factored.values()):.0f} s, {min(factored.values()) / ours:.1f}x"
    return [
        Row(
            f"{queries} queries, mean, normal and all four variances, n = {n}, against GPyTorch's RBFKernelGrad",
            f">= {least_ratio:.0f}x faster at its best chunk",
            f"{ratio:.1f}x: {ours:.2f} s against {min(theirs.values()):.0f} s{told if 4 * n > 800 else ''}",
            ratio >= least_ratio,
            numbers,
        ),
        Row(
            f"the same, n = {n}, against the product of a triangular matrix (half of a dense one)",
            "<= 2.5x the floor",
            f"{ours / floor:.2f}x: {ours:.2f} s against {floor:.2f} s",
            ours / floor <= 2.5,
            numbers,
        ),
    ]


def time_gpytorch(n: int, points: Tensor, dense: bool) -> dict[int, float]:
    """Return the time [s] that GPyTorch would take for all points, by the size of the chunk, each from one chunk."""
    x, normals = random_view(n, torch.Generator().manual_seed(0))
    query = gpytorch_posterior(x, torch.cat([torch.zeros_like(x[:, :1]), normals], 1), NOISE, dense)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of negative variances, which its conjugate gradients leave
        return {c: least_seconds(partial(query, points[:c])) * len(points) / c for c in CHUNKS}


def bench_memory(queries: int, threads: int) -> Row:
    """Predict at many points in a process of its own and return how far the peak of its memory rises."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        rise = pool.apply(_rise, (queries, threads))
    return Row(
        f"memory of {queries} queries at n = 300, the answers included",
        "<= 1.5 GiB over the start",
        "not told by this system" if rise is None else f"{rise / 1024:.2f} GiB",
        None if rise is None else rise <= 1536,
        {"rise_mib": rise, "queries": queries},
    )


def _rise(queries: int, threads: int) -> float | None:
    """Return the rise of the peak [MiB] during the queries."""
    torch.set_num_threads(threads)
    shape = posterior(300)
    points = queries_in(shape, queries)
    shape.predict(points[:16])
    before = peak_mib()
    shape.predict(points)
    after = peak_mib()
    return None if before is None or after is None else after - before


def bench_raw(queries: int) -> Row:
    """Fit to 1000 raw points with normals, then ask for means and normals."""
    x, normals = random_view(1000, torch.Generator().manual_seed(0))
    seen, cloud = observe(x, normals), PointCloud(x, normals)
    fit = least_seconds(lambda: condition(seen, Normalisation(x.new_zeros(3), 1.0), cloud, PSI_SCALE), repeats=2)
    shape = condition(seen, Normalisation(x.new_zeros(3), 1.0), cloud, PSI_SCALE)
    points = queries_in(shape, queries)
    means = least_seconds(lambda: shape.mean_and_gradient(shape.normalise(points)), repeats=2)
    return Row(
        f"1000 raw points, no selection (4000 rows): fit and {queries} means and normals",
        "<= 3 s on two cores",
        f"{fit + means:.2f} s: {fit:.2f} s + {means:.2f} s",
        fit + means <= 3,
        {"fit_s": fit, "means_s": means},
    )


def bench_growth(out: Path) -> Row:
    """Fit and query with 30 to 1000 points; draw both, with the powers of n that they approach."""
    rows: list[dict[str, Any]] = []
    count = 2000
    for n in GROWTH:
        x, normals = random_view(n, torch.Generator().manual_seed(0))
        seen, cloud = observe(x, normals), PointCloud(x, normals)
        fit = least_seconds(
            partial(condition, seen, Normalisation(x.new_zeros(3), 1.0), cloud, PSI_SCALE), 2 if n > 300 else 5
        )
        shape = posterior(n)
        points = queries_in(shape, count)
        query = least_seconds(partial(shape.predict, points), 2 if n > 300 else 5)
        rows.append({"n": n, "fit_s": fit, "queries_per_s": count / query})
    draw_growth(rows, out)
    last, before = rows[-1], rows[-2]
    step = torch.log(torch.tensor(last["n"] / before["n"]))
    power = [
        float(torch.log(torch.tensor(last["fit_s"] / before["fit_s"])) / step),
        float(torch.log(torch.tensor(before["queries_per_s"] / last["queries_per_s"])) / step),
    ]
    table = "\n".join(f"        {r['n']:6}{1e3 * r['fit_s']:12.1f}{r['queries_per_s']:14.0f}" for r in rows)
    return Row(
        f"growth with n; drawn in {out}",
        "fit O(n^3), query O(n^2)",
        f"fit n^{power[0]:.1f}, query n^{power[1]:.1f} from {before['n']} to {last['n']} points\n"
        f"        {'n':>6}{'fit ms':>12}{'queries/s':>14}\n{table}",
        None,
        {"rows": rows, "powers": power},
    )


def draw_growth(rows: list[dict[str, Any]], out: Path) -> None:
    """Draw the growth as a picture on two logarithmic axes."""
    from matplotlib.figure import Figure

    n = [r["n"] for r in rows]
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    for axes, values, power, title in (
        (left, [1e3 * r["fit_s"] for r in rows], 3, "fit [ms]"),
        (right, [1e6 / r["queries_per_s"] for r in rows], 2, "one query, mean and covariance [us]"),
    ):
        axes.loglog(n, values, "o-", color="black", label="measured")
        axes.loglog(n, [values[-1] * (m / n[-1]) ** power for m in n], "--", color="grey", label=f"n^{power}")
        axes.set(xlabel="observed points with normals", title=title)
        axes.legend(frameon=False)
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=150)
