"""Regressor, base parameters, weighted least squares and the whole command, against pinocchio and FIGAROH.

Run `python -m benchmarks.identification [--figaroh] [--samples 100000] [--no-command]`. CPU seconds on one
core, LWR4+, random states; the ratio is the other's time over ours. `--figaroh` installs FIGAROH from PyPI
into a temporary environment (`--figaroh-python PATH` takes one that has it). Then `lwr-run identify` is run
on two 60 s sessions and on two 600 s sessions, 1 kHz, one of each pair with a payload: CPU and peak memory.

Rigid arm: 70 columns, 43 base parameters, 7 rows a sample, all made and held as a matrix, as the others do.
"""

from __future__ import annotations

import argparse
import json
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import resource
import subprocess
import sys
import tempfile
import time
import venv
from pathlib import Path

import numpy as np
import pinocchio as pin

from benchmarks.regressor import cpu_s, pinocchio_loop
from ident.dynamics.base_set import numeric_base
from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import DRIVE
from ident.dynamics.regressor import rigid_regressor, torque
from ident.dynamics.structure import ModelStructure
from ident.estimators import CovarianceSettings, Problem, RowGroup, WeightedLeastSquares
from ident.import_log import LogMapping, import_log
from lwr_driver.configuration import find

NOISE = np.array([0.4, 0.4, 0.25, 0.25, 0.2, 0.1, 0.1])
FIGAROH = """
import json, sys, time
from types import SimpleNamespace
import numpy as np, pinocchio as pin
from figaroh.identification.base_identification import BaseIdentification
from figaroh.identification.identification_tools import relative_stdev
from figaroh.tools.qrdecomposition import QRDecomposer
from figaroh.tools.regressor import RegressorBuilder, RegressorConfig
from figaroh.tools.regressor import build_regressor_reduced, get_index_eliminate

data = np.load(sys.argv[2])
model = pin.buildModelFromUrdf(sys.argv[1])
q, qd, qdd, tau = data["q"], data["qd"], data["qdd"], data["tau"].T.ravel()
builder = RegressorBuilder(SimpleNamespace(model=model, data=model.createData()), RegressorConfig())
settings = {"act_idxv": list(range(model.nv))}
builder.build_basic_regressor(q[:100], qd[:100], qdd[:100], settings)
clock = time.process_time
t0 = clock()
w = builder.build_basic_regressor(q, qd, qdd, settings)
t1 = clock()
names = {f"p{k}": 0.0 for k in range(w.shape[1])}
idle, rest = get_index_eliminate(w, names)
base, _, _, values = QRDecomposer().double_decomposition(tau, build_regressor_reduced(w, idle), rest)
t2 = clock()
rows = len(q)
residual = (tau - base @ values).reshape(-1, rows)
sigma = np.repeat(np.var(residual, axis=1), rows)
Solver = type("Solver", (BaseIdentification,), {"load_trajectory_data": None})
solver = Solver.__new__(Solver)
values, _ = solver._solve_weighted_least_squares(base, tau, sigma)
relative_stdev(base, values, tau)
t3 = clock()
print(json.dumps({"regressor": t1 - t0, "base": t2 - t1, "wls": t3 - t2, "count": base.shape[1]}))
"""
MAPPING = """schema_version: 1
robot: simulated LWR4+
joints: [A1, A2, E1, A3, A4, A5, A6]
urdf: lwr4plus.urdf
time: {column: time, unit: s}
position: {array: q, unit: rad}
joint_torque: {array: joint, unit: Nm}
motor_torque: {array: motor, unit: Nm}
"""


def figaroh(states: tuple[np.ndarray, ...], tau: np.ndarray, python: Path | None) -> dict[str, float]:
    """CPU seconds of FIGAROH's stages on the same data, in an environment of its own."""
    with tempfile.TemporaryDirectory() as folder:
        if python is None:
            venv.create(Path(folder) / "env", with_pip=True)
            python = Path(folder) / "env" / "bin" / "python"
            subprocess.run([python, "-m", "pip", "install", "-q", "figaroh"], check=True)
        path = Path(folder) / "data.npz"
        np.savez(path, q=states[0], qd=states[1], qdd=states[2], tau=tau)
        command = [str(python), "-W", "ignore", "-c", FIGAROH, str(find("lwr4plus.urdf")), str(path)]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def stages(samples: int, with_figaroh: bool, python: Path | None) -> None:
    """The table of stages."""
    urdf = find("lwr4plus.urdf")
    chain, model = Chain.from_urdf(urdf), pin.buildModelFromUrdf(str(urdf))
    random = np.random.default_rng(0)
    q, qd, qdd = states = tuple(random.uniform(-2.0, 2.0, (3, samples, 7)))
    tau = torque(chain, q, qd, qdd, chain.urdf_inertials()) + NOISE * random.normal(size=q.shape)
    structure = ModelStructure(chain, 1, without=DRIVE)
    base = numeric_base(structure)

    def fitting(covariance: CovarianceSettings) -> float:
        # A problem keeps its factors, so each run gets a new one.
        times = []
        for _ in range(3):
            problem = assembled()
            start = time.process_time()
            WeightedLeastSquares(covariance).fit(problem)
            times.append(time.process_time() - start)
        return min(times)

    def held() -> None:
        WeightedLeastSquares(CovarianceSettings("textbook")).fit(assembled())

    def assembled() -> Problem:
        columns = numeric_base(structure).columns
        matrix = structure.regressor(q, qd, qdd, columns=columns).reshape(7, samples, -1)
        index = np.arange(samples)
        groups = tuple(
            RowGroup(chain.joint_names[j], "joint", 0, matrix[j], tau[:, j], index) for j in range(7)
        )
        return Problem(base.names, groups, 1e-3)

    loop = cpu_s(lambda: pinocchio_loop(model, q, qd, qdd), repeats=2)
    out, block = np.zeros((70, 7, samples)), np.zeros((70, 7, 4096))
    parts = [tuple(x[end - 4096 : end] for x in states) for end in range(4096, samples + 1, 4096)]
    ours = {
        "new": cpu_s(lambda: rigid_regressor(chain, q, qd, qdd)),
        "reused": cpu_s(lambda: rigid_regressor(chain, q, qd, qdd, out=out)),
        "blocks": cpu_s(lambda: [rigid_regressor(chain, *part, out=block) for part in parts]),
    }
    if parts:
        ours["blocks"] *= samples / (4096 * len(parts))
    ours["base"] = cpu_s(lambda: numeric_base(structure), repeats=5)
    ours["wls"], ours["robust"] = fitting(CovarianceSettings("textbook")), fitting(CovarianceSettings())
    ours["held"] = cpu_s(held, repeats=2)
    theirs = figaroh(states, tau, python) if with_figaroh else None
    whole = None if theirs is None else theirs["regressor"] + theirs["base"] + theirs["wls"]

    def row(label: str, own: float, loop_s: float | None, figaroh_s: float | None) -> None:
        cells = [f"{own:10.4f}"]
        for other in (loop_s, figaroh_s):
            cells.append(f"{other:11.3f} {other / own:7.1f}x" if other is not None else " " * 20)
        print(f"{label:<46}{' '.join(cells)}")

    print(f"{samples} samples, {len(base)} base parameters")
    print(f"{'':<46}{'ours, s':>10} {'pinocchio, s':>20} {'FIGAROH, s':>20}")
    built = None if theirs is None else theirs["regressor"]
    row("regressor, new array", ours["new"], loop, built)
    row("regressor, array reused", ours["reused"], loop, built)
    row("regressor, blocks of 4096 (as identify does)", ours["blocks"], loop, built)
    row("numeric base parameters", ours["base"], None, None if theirs is None else theirs["base"])
    row("WLS with RSD, equation (14)", ours["wls"], None, None if theirs is None else theirs["wls"])
    row("WLS with jackknife and HAC covariance", ours["robust"], None, None)
    row("all together, matrix held", ours["held"], None, whole)
    if theirs is not None:
        print(f"FIGAROH: {theirs['count']:.0f} base parameters; the base step solves least squares, too")


def session(folder: Path, length_s: float, loaded: bool) -> Path:
    """A simulated session of 1 kHz on both channels: Fourier motion, white torque noise."""
    chain = Chain.from_urdf(find("lwr4plus.urdf"))
    random = np.random.default_rng(int(loaded))
    time_s = np.arange(round(1e3 * length_s) + 1) * 1e-3
    q, qd, qdd = (np.zeros((len(time_s), 7)) for _ in range(3))
    shape = np.random.default_rng(5)
    for k in range(1, 6):
        w, amplitude = 2 * np.pi * k / 20.0, 0.3 * shape.normal(size=(2, 7))
        s, c = np.sin(w * time_s)[:, None], np.cos(w * time_s)[:, None]
        q += amplitude[0] * s + amplitude[1] * c
        qd += w * (amplitude[0] * c - amplitude[1] * s)
        qdd -= w * w * (amplitude[0] * s + amplitude[1] * c)
    bodies = chain.urdf_inertials()
    if loaded:
        bodies[-1] += [0.0895, 0.0, 0.0, 0.07, 0.03, 0.0215, 0.0, -0.22, 0.48, 3.34]
    joint = torque(chain, q, qd, qdd, bodies) + 0.3 * np.sign(qd)
    motor = joint + 2.0 * qdd + 8.0 * qd + 9.0 * np.sign(qd) + NOISE * random.normal(size=q.shape)
    joint = joint + NOISE * random.normal(size=q.shape)
    mapping, data = folder / "mapping.yaml", folder / "data.npz"
    mapping.write_text(MAPPING, encoding="utf-8")
    np.savez(data, time=time_s, q=q, joint=joint, motor=motor)
    path = folder / f"{'loaded' if loaded else 'bare'}_{length_s:g}.mcap"
    import_log(LogMapping.load(mapping), data, path, payload="load" if loaded else "none")
    data.unlink()
    return path


def command(length_s: float) -> None:
    """`lwr-run identify` on a session without and one with payload: CPU and peak memory of the process."""
    with tempfile.TemporaryDirectory() as folder:
        maker = (
            f"from benchmarks.{Path(__file__).stem} import session; from pathlib import Path; "
            f"[session(Path({folder!r}), {length_s}, loaded) for loaded in (False, True)]"
        )
        subprocess.run([sys.executable, "-c", maker], check=True, cwd=Path(__file__).parents[1])
        files = [str(Path(folder) / f"{name}_{length_s:g}.mcap") for name in ("bare", "loaded")]
        start = resource.getrusage(resource.RUSAGE_CHILDREN)
        program = (
            "import sys, resource; from runner.cli import main; "
            "sys.argv[0] = 'lwr-run'\n"
            "try: main()\n"
            "finally: print(open('/proc/self/status').read().split('VmHWM:')[1].split()[0], file=sys.stderr)"
        )
        done = subprocess.run(
            [sys.executable, "-c", program, "identify", *files], check=True, capture_output=True, text=True
        )
        stop = resource.getrusage(resource.RUSAGE_CHILDREN)
        cpu = stop.ru_utime + stop.ru_stime - start.ru_utime - start.ru_stime
        peak = float(done.stderr.split()[-1]) / 1024.0
        print(f"lwr-run identify, two sessions of {length_s:g} s, 1 kHz: CPU {cpu:.1f} s, peak {peak:.0f} MB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--samples", type=int, default=100_000)
    parser.add_argument("--figaroh", action="store_true", help="Compare with FIGAROH from PyPI.")
    parser.add_argument("--figaroh-python", type=Path, help="An interpreter that has FIGAROH already.")
    parser.add_argument("--no-command", action="store_true", help="Leave `lwr-run identify` out.")
    options = parser.parse_args()
    stages(options.samples, options.figaroh or options.figaroh_python is not None, options.figaroh_python)
    if not options.no_command:
        for length_s in (60.0, 600.0):
            command(length_s)


if __name__ == "__main__":
    main()
