"""Regressor and base parameters against plain pinocchio (and FIGAROH, where it is installed).

Run `python -m benchmarks.regressor [--samples 100000]`. It prints CPU seconds on one core (best of the runs)
and ratios to pinocchio's loop. A busy machine changes the seconds by half, the ratios little.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import sys
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin

from ident.dynamics.base_closed_form import closed_form_base
from ident.dynamics.base_set import numeric_base
from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import from_pinocchio
from ident.dynamics.regressor import rigid_regressor, torque
from ident.dynamics.structure import ModelStructure
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


def call_us(run: Callable[[], Any], calls: int = 2000) -> float:
    """Least CPU time of one call, over nine rounds of `calls` [us]."""
    return 1e6 * cpu_s(lambda: [run() for _ in range(calls)], repeats=9) / calls


def pinocchio_loop(model: Any, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    """Python loop over the samples, into one array."""
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
    options = parser.parse_args()
    n = options.samples
    urdf = find("lwr4plus.urdf")
    chain, model = Chain.from_urdf(urdf), pin.buildModelFromUrdf(str(urdf))
    q, qd, qdd = np.random.default_rng(0).uniform(-2.0, 2.0, (3, n, 7))
    structure = ModelStructure(chain, 2, payloads=("load",))
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

    print(ROW.format("single calls, one sample each", "us", "", "pin = 1"))
    now, data = (q[0].copy(), qd[0].copy(), qdd[0].copy()), model.createData()
    for label, mine, peer in (
        (
            "torque / pinocchio rnea",
            lambda: torque(chain, *now, inertial),
            lambda: pin.rnea(model, data, *now),
        ),
        (
            "rigid_regressor / pinocchio computeJointTorqueRegressor",
            lambda: rigid_regressor(chain, *now),
            lambda: pin.computeJointTorqueRegressor(model, data, *now),
        ),
    ):
        own, other = (call_us(one) for one in (mine, peer))
        print(ROW.format(label, f"{own:.2f} / {other:.2f}", "", f"{own / other:.1f}"))

    print(ROW.format("", "CPU ms", "", ""))
    for label, run in (
        ("base parameters, numeric (136 columns, two sessions)", lambda: numeric_base(structure)),
        ("base parameters, closed form", lambda: closed_form_base(structure)),
    ):
        print(ROW.format(label, f"{1e3 * cpu_s(run, repeats=5):.2f}", "", ""))


if __name__ == "__main__":
    if "OPENBLAS_NUM_THREADS" not in os.environ:
        # numpy reads this when it is loaded, so the script starts again with it.
        os.environ["OPENBLAS_NUM_THREADS"] = "1"
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
    main()
