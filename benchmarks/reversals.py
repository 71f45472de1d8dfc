"""What to do with the samples beside reversals, where friction follows no sign function?

Run `python -m benchmarks.reversals [--pairs 4] [--first-seed 700]`. Pairs of sessions of emulated arms, stiff and
elastic, with and without friction that turns slowly after a reversal, and with friction that falls with the speed
(Stribeck), are identified in six ways: all samples with sign(qd); all samples with tanh(qd / width) in the rows, the
width chosen by held-back error; samples beside reversals left out, with that law in the rows; with sign(qd) in the
rows and the law in the model; slow motion left out besides (as it comes); and as `lwr-run identify` does, with friction
that turns over a path in the model.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.coverage import kind
from ident.dynamics.kinematics import Chain
from ident.dynamics.structure import Coulomb
from ident.estimation.identification import Identification, IdentificationSettings
from ident.estimation.identify import identify
from ident.estimation.validate import validate
from ident.estimators.names import AUTO
from ident.rows.filters import SignalSettings
from lwr_driver.arm import Arm
from tests.ident.estimation.emulated_sessions import record_pair
from tests.ident.estimation_arm import true_base

_STIFF = [1.5e5, 1.5e5, 1.2e5, 1.2e5, 8e4, 6e4, 6e4]
_TURNING = {"type": "tests.hidden_physics.arm:HiddenArm", "options": {}}
_FALLING = {
    "type": "tests.hidden_physics.arm:HiddenArm",
    "options": {
        "traits": {
            "stribeck": dict.fromkeys(range(1, 8), 0.25),
            "stribeck_speed": dict.fromkeys(range(1, 8), 0.1),
        }
    },
}
SCENES: dict[str, dict[str, Any]] = {
    "elastic": {},
    "stiff": {"robot.stiffness": _STIFF},
    "elastic, slow turning": {"robot.plant": _TURNING},
    "stiff, slow turning": {"robot.plant": _TURNING, "robot.stiffness": _STIFF},
    "elastic, Stribeck": {"robot.plant": _FALLING},
}
_SHOWN = ("Ia", "Fvm", "Fcm")


def ways(chosen: Identification) -> dict[str, IdentificationSettings]:
    """The settings of the six ways, from an identification as it comes."""
    settings, signals = chosen.settings, chosen.settings.signals
    assert settings.coulomb is not None
    everything = replace(signals, reversal_s=0.0, slow_rad_s=0.0, standstill_rad_s=0.0)
    turning = replace(signals, slow_rad_s=0.0)
    return {
        "all, sign": replace(settings, signals=everything, coulomb=Coulomb(), row_coulomb=Coulomb()),
        "all, smooth": replace(settings, signals=everything, row_coulomb=settings.coulomb),
        "left out, smooth": replace(settings, signals=turning, row_coulomb=settings.coulomb),
        "left out, sign": replace(settings, signals=turning, row_coulomb=Coulomb()),
        "as it comes": settings,
        "in the model": replace(settings, estimator=AUTO),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--pairs", type=int, default=4)
    parser.add_argument("--first-seed", type=int, default=700)
    parser.add_argument("--cycle-ms", type=int, default=1)
    options = parser.parse_args(arguments)
    arm = Arm.load()
    chain = Chain.from_urdf(arm.urdf)
    wanted = IdentificationSettings(
        essential=None, signals=SignalSettings(stiffness_nm_rad=tuple(arm.stiffness.tolist()))
    )
    print(
        "coverage of the 95 % intervals [%], mean |error| of Ia [%], torque error of a further motion, motor side [%]"
    )
    for scene, settings in SCENES.items():
        rows: dict[str, dict[str, list[float]]] = {}
        for seed in range(options.first_seed, options.first_seed + options.pairs):
            with tempfile.TemporaryDirectory() as folder:
                make = {"cycle_ms": options.cycle_ms, "settings": settings}
                sessions = record_pair(Path(folder), seed, **make)
                further = record_pair(Path(folder), seed + 500, periods=1, **make)
                for name, way in ways(identify(sessions, chain, wanted)).items():
                    found = identify(sessions, chain, way)
                    _collect(rows.setdefault(name, {}), found)
                    errors = [score.relative["motor"] for score in validate(found.model, further).scores]
                    rows[name].setdefault("further", []).append(float(np.mean(errors)))
        for name, row in rows.items():
            figures = "  ".join(f"{symbol} {100.0 * np.mean(row[symbol]):5.1f}" for symbol in _SHOWN)
            error, further_error = (100.0 * np.mean(row[key]) for key in ("error", "further"))
            print(f"{scene:<22} {name:<17} {figures}   {error:5.2f}   {further_error:5.2f}", flush=True)


def _collect(row: dict[str, list[float]], found: Identification) -> None:
    truth, estimate = true_base(found), found.estimate
    low, high = estimate.interval(0.95).T
    for k, name in enumerate(found.base.names):
        symbol = kind(name, found.structure.chain.n)
        if symbol in _SHOWN:
            row.setdefault(symbol, []).append(float(low[k] < truth[k] < high[k]))
        if symbol == "Ia":
            row.setdefault("error", []).append(abs(estimate.values[k] / truth[k] - 1.0))


if __name__ == "__main__":
    main()
