"""Regressor, base parameters and accumulation against plain pinocchio (and FIGAROH, where it is installed).

Run `python -m benchmarks.regressor [--samples 100000]`. It prints CPU seconds on one core (best of the runs),
ratios to pinocchio's loop, and the peak memory of a long two-payload record. A busy machine changes the
seconds by half, the ratios little.
"""

from __future__ import annotations

import argparse
import importlib.util
import multiprocessing
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin

from ident.accumulation import Accumulation, solve_normal
from ident.base import closed_form_base, numeric_base
from ident.kinematics import Chain
from ident.parameters import from_pinocchio
from ident.regressor import rigid_regressor, torque
from ident.structure import ModelStructure, Samples
from lwr_driver.configuration import find

ROW = "{:<62}{:>10}{:>9}{:>10}"


def cpu_s(run: Callable[[], Any], repeats: int = 3) -> float:
    """Smallest CPU time of `repeats` runs after a first one that compiles and warms the caches."""
    run()
    best = float("inf")
    for _ in range(repeats):
        start = time.process_time()
        run()
        best = min(best, time.process_time() - start)
    return best


def peak_mb() -> float:
    """Largest resident size of this process (getrusage would count the parent's as well)."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024.0


def pinocchio_loop(model: Any, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    data = model.createData()
    stacked = np.empty((model.nv, len(q), 10 * model.nv))
    for k in range(len(q)):
        stacked[:, k] = pin.computeJointTorqueRegressor(model, data, q[k], qd[k], qdd[k])
    return stacked


def figaroh_loop(model: Any, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> Callable[[], Any] | None:
    if importlib.util.find_spec("figaroh") is None:
        return None
    from figaroh.tools.regressor import RegressorBuilder, RegressorConfig

    builder = RegressorBuilder(SimpleNamespace(model=model, data=model.createData()), RegressorConfig())
    settings = {"act_idxv": list(range(model.nv))}
    return lambda: builder.build_basic_regressor(q, qd, qdd, settings)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--samples", type=int, default=100_000, help="samples of the regressor (default 100000)"
    )
    parser.add_argument(
        "--record-s", type=float, default=600.0, help="length of the long record (default 600 s)"
    )
    options = parser.parse_args()
    n = options.samples
    urdf = find("lwr4plus.urdf")
    chain, model = Chain.from_urdf(urdf), pin.buildModelFromUrdf(str(urdf))
    q, qd, qdd = np.random.default_rng(0).uniform(-2.0, 2.0, (3, n, 7))
    structure = ModelStructure(chain, 2, payloads=("load",))
    base = numeric_base(structure)
    loop = cpu_s(lambda: pinocchio_loop(model, q, qd, qdd), repeats=2)

    print(f"LWR4+, {n} samples, one core; ratio: pinocchio's loop / this")
    print(ROW.format("", "CPU s", "us/smp", "ratio"))

    def report(label: str, seconds: float) -> None:
        print(ROW.format(label, f"{seconds:.4f}", f"{1e6 * seconds / n:.2f}", f"{loop / seconds:.1f}"))

    report("pinocchio computeJointTorqueRegressor, Python loop", loop)
    figaroh = figaroh_loop(model, q, qd, qdd)
    if figaroh is not None:
        report("FIGAROH build_regressor_basic, rigid", cpu_s(figaroh, repeats=1))
    report("rigid_regressor, 70 columns, new array", cpu_s(lambda: rigid_regressor(chain, q, qd, qdd)))
    out = np.zeros((70, 7, n))
    report(
        "rigid_regressor, 70 columns, array reused",
        cpu_s(lambda: rigid_regressor(chain, q, qd, qdd, out=out)),
    )
    block = np.zeros((70, 7, 4096))
    ends = range(4096, n + 1, 4096)
    parts = [tuple(x[end - 4096 : end] for x in (q, qd, qdd)) for end in ends]
    if parts:
        seconds = cpu_s(lambda: [rigid_regressor(chain, *part, out=block) for part in parts])
        report("rigid_regressor, 70 columns, blocks of 4096", seconds * n / (4096 * len(parts)))
    theirs = pinocchio_loop(model, q[:100], qd[:100], qdd[:100]).reshape(7, 100, 7, 10)
    ours = rigid_regressor(chain, q[:100], qd[:100], qdd[:100])
    error = np.abs(ours - from_pinocchio(theirs).reshape(7, 100, 70)).max()
    print(f"largest difference from pinocchio: {error:.1e}")
    inertial = np.ones((7, 10))
    report("torque (inverse dynamics)", cpu_s(lambda: torque(chain, q, qd, qdd, inertial)))

    motor = joint = np.ones((n, 7))
    bare, loaded = Samples(q, qd, qdd, motor, joint), Samples(q, qd, qdd, motor, joint, "load")

    def accumulate(factor: str) -> Accumulation:
        accumulation = Accumulation(structure, base.columns, factor=factor)  # type: ignore[arg-type]
        accumulation.add(bare, session=0)
        return accumulation

    report("Model 2, 102 columns, 14 rows: Gram accumulation", cpu_s(lambda: accumulate("gram")))
    report("Model 2, 102 columns, 14 rows: triangular factors", cpu_s(lambda: accumulate("qr"), repeats=1))
    accumulation = accumulate("gram")
    accumulation.add(loaded, session=1)

    def solve() -> None:
        parts = [accumulation.normal(side, j) for side in structure.sides for j in range(7)]
        solve_normal(parts, [1.0] * len(parts))

    print(ROW.format("", "CPU ms", "", ""))
    for label, run in (
        ("WLS step from accumulated data (102 parameters)", solve),
        ("base parameters, numeric (136 columns, two sessions)", lambda: numeric_base(structure)),
        ("base parameters, closed form", lambda: closed_form_base(structure)),
    ):
        print(ROW.format(label, f"{1e3 * cpu_s(run, repeats=5):.2f}", "", ""))

    context = multiprocessing.get_context("spawn")
    with context.Pool(1) as pool:
        before, after = pool.apply(long_record, (options.record_s,))
    whole = 2 * options.record_s * 1e3 * 14 * len(base) * 8 / 1e9
    print(
        f"{options.record_s:g} s at 1 kHz, two payloads, Model 2, streamed: peak {after:.0f} MB, of which "
        f"{before:.0f} MB before the first sample; the whole matrix would take {whole:.1f} GB"
    )


def long_record(length_s: float) -> tuple[float, float]:
    """Accumulate two sessions that arrive second by second; peak memory before and after [MB]."""
    structure = ModelStructure(Chain.from_urdf(find("lwr4plus.urdf")), 2, payloads=("load",))
    accumulation = Accumulation(structure, numeric_base(structure).columns)
    before, rng = peak_mb(), np.random.default_rng(1)
    for session, payload in enumerate((None, "load")):
        for _ in range(int(length_s)):
            q, qd, qdd, motor, joint = rng.uniform(-2.0, 2.0, (5, 1000, 7))
            accumulation.add(Samples(q, qd, qdd, motor, joint, payload), session=session)
    return before, peak_mb()


if __name__ == "__main__":
    if "OPENBLAS_NUM_THREADS" not in os.environ:
        # numpy reads this when it is loaded, so the script starts again with it.
        os.environ["OPENBLAS_NUM_THREADS"] = "1"
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
    main()
