"""Independent searches for one motion, over processes: how much of two is used, and what sixteen would wait.

    python -m benchmarks.excitation.spread --searches 8
    python -m benchmarks.excitation.spread --searches 16 --hops 120

Runs the same searches in one process and in two, compares the motions, and prints processor and wall time. A longer
queue for sixteen workers, each taking the next search when it has ended one, is made up of the measured times of single
searches; its idle share is what a cluster of sixteen processors would waste. Only ratios of one run mean anything.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import heapq
import time
from dataclasses import replace

import click
import numpy as np

from ident.excitation import PlanProblem, Search, assemble, plan
from ident.excitation.plan import spread_text
from ident.excitation.planner import one_search

WORKERS = 16


def idle_share(durations: np.ndarray, workers: int) -> float:
    """Share of the workers' time without work until the last task ends, tasks taken in their order."""
    free = [0.0] * workers
    for duration in durations:
        heapq.heappush(free, heapq.heappop(free) + float(duration))
    return 1.0 - float(durations.sum()) / (workers * max(free))


@click.command()
@click.option("--searches", default=8, show_default=True, help="Number of searches.")
@click.option("--starts", default=2, show_default=True, help="Random starts of a search.")
@click.option("--hops", default=20, show_default=True, help="Perturbations of a search.")
@click.option("--seed", default=1, show_default=True, help="Of the first search.")
def main(searches: int, starts: int, hops: int, seed: int) -> None:
    """Time independent searches in one process, in two, and in sixteen simulated ones."""
    problem = PlanProblem.load("plans/default.yaml")
    extent = Search(seed=seed, starts=starts, hops=hops, lanes=1)
    setup = assemble(problem).setup
    one_search(setup, replace(extent, hops=0))  # compiles
    durations = []
    for k in range(searches):
        begun = time.process_time()
        one_search(setup, replace(extent, seed=seed + k))
        durations.append(time.process_time() - begun)
    times = np.array(durations)
    click.echo(
        f"{searches} searches, one after the other: {times.sum():.1f} s of a processor, {times.min():.1f} to "
        f"{times.max():.1f} s each"
    )
    walls, found = [], []
    for jobs in (1, 2):
        spread = replace(problem, search=replace(extent, searches=searches, jobs=jobs))
        begun = time.perf_counter()
        found.append(plan(spread))
        walls.append(time.perf_counter() - begun)
    equal = np.array_equal(found[0].sample(3.3).q, found[1].sample(3.3).q)
    click.echo(
        f"wall time with 1 and 2 processes: {walls[0]:.1f} and {walls[1]:.1f} s, {walls[0] / walls[1]:.2f} times "
        f"faster, the same motion: {'yes' if equal else 'NO'}"
    )
    random = np.random.default_rng(1)
    for number in (1, 4, 16):
        shares = [idle_share(random.choice(times, number * WORKERS), WORKERS) for _ in range(200)]
        click.echo(f"{WORKERS} workers, {number * WORKERS} searches: idle {100.0 * np.mean(shares):.0f} %")
    click.echo(spread_text(found[0].provenance["searches"]))


if __name__ == "__main__":
    main()
