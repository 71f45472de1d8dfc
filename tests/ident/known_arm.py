"""An arm of known parameters, and sessions of it, as fixtures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from ident.dynamics import parameters
from ident.dynamics.base_set import numeric_base
from ident.dynamics.kinematics import Chain
from ident.dynamics.structure import ModelStructure
from ident.model.dynamic_model import DynamicModel
from lwr_driver.configuration import CONFIGS
from lwr_driver.session import Session, SessionWriter, read_session, session_metadata

Floats = NDArray[np.float64]
START_NS = 1_700_000_000_000_000_000
LOAD = parameters.from_com(3.3, [0.01, -0.06, 0.14], [[0.02, 0, 0], [0, 0.018, 0.001], [0, 0.001, 0.009]])


@dataclass(frozen=True)
class Bench:
    """An arm with known parameters, and sessions of it in a folder."""

    chain: Chain
    structure: ModelStructure
    truth: DynamicModel
    folder: Path

    def motion(self, seed: int, duration_s: float, rate_hz: float, period_s: float) -> tuple[Floats, ...]:
        """Times (N,), and q, qd, qdd (N, n) of a random Fourier series of that period."""
        rng = np.random.default_rng(seed)
        t = np.arange(round(duration_s * rate_hz)) / rate_hz
        w = 2 * np.pi / period_s
        a, b = rng.normal(size=(2, self.chain.n, 5)) * 0.5
        k = np.arange(1, 6)
        phase = w * t[:, None, None] * k
        amplitude = 1.0 / (w * k)
        q = np.sum(amplitude * (a * np.sin(phase) - b * np.cos(phase)), axis=2)
        qd = np.sum(a * np.cos(phase) + b * np.sin(phase), axis=2)
        qdd = np.sum(w * k * (b * np.cos(phase) - a * np.sin(phase)), axis=2)
        return t, q + rng.uniform(-0.3, 0.3, self.chain.n), qd, qdd

    def session(
        self,
        name: str,
        *,
        seed: int,
        payload: str = "none",
        announced: float | None = None,
        uid: str | None = None,
        periods: int = 1,
        noise_nm: tuple[float, float] = (0.05, 0.2),
        model: DynamicModel | None = None,
        controller_model: bool = False,
        motor: bool = True,
        rate_hz: float = 125.0,
    ) -> Session:
        """Record the arm moving along a random excitation; torque noise on (joint, motor) sensors."""
        source = model or self.truth
        period_s, rate = 12.0, rate_hz
        t, q, qd, qdd = self.motion(seed, periods * period_s + 2.0, rate, period_s)
        mounted = None if payload == "none" else payload
        rng = np.random.default_rng(seed + 1000)
        joint = source.torque(q, qd, qdd, payload=mounted, side="joint")
        drive = source.torque(q, qd, qdd, payload=mounted, side="motor")
        log = START_NS + np.rint(t * 1e9).astype(np.int64)
        path = self.folder / f"{name}.mcap"
        metadata = session_metadata(
            robot=source.robot, payload=payload, payload_mass=announced, uid=uid or f"uid-{name}"
        )
        with SessionWriter(path, self.chain.joint_names, metadata, start_ns=START_NS) as writer:
            publish = np.rint(t * 1e9).astype(np.int64)
            writer.write_phase(int(log[0]), "settle")
            for k in range(periods):
                writer.write_phase(int(log[round((1.0 + k * period_s) * rate)]), f"period {k + 1}")
            writer.write_phase(int(log[round((1.0 + periods * period_s) * rate)]), "brake")
            effort = joint + noise_nm[0] * rng.normal(size=joint.shape)
            writer.write_joint_states(log, q, effort, publish_time=publish)
            if motor:
                effort = drive + noise_nm[1] * rng.normal(size=drive.shape)
                writer.write_motor_states(log, effort, publish_time=publish)
            writer.write_joint_command(log, q, publish_time=publish)
            if controller_model:
                some = slice(0, None, 5)
                writer.write_controller_model(
                    log[some],
                    mass_matrix=source.mass_matrix(q[some], payload=mounted),
                    gravity=source.gravity(q[some], payload=mounted),
                    jacobian=np.zeros((len(q[some]), 6, 7)),
                    estimated_external_torque=np.zeros_like(q[some]),
                    publish_time=publish[some],
                )
        return read_session(path)


def truth() -> DynamicModel:
    """Table 2 with a load of our own, exactly known: base parameters of Model 2, unloaded and loaded."""
    chain = Chain.from_urdf(CONFIGS / "lwr4plus.urdf")
    structure = ModelStructure(chain, 2, payloads=("load",))
    values = yaml.safe_load((CONFIGS / "emulator" / "table2.yaml").read_text())["parameters"]
    load = dict(zip(parameters.INERTIAL, LOAD, strict=True))
    standard = np.array(
        [
            float(values.get(name, load.get(name[:-1], 0.0) if name[-1] == "8" else 0.0))
            for name in structure.names
        ]
    )
    base = numeric_base(structure)
    return DynamicModel("LWR4+", structure, base.names, base.reduce(standard), None, base)


@pytest.fixture(scope="session")
def truth_model() -> DynamicModel:
    """The model of `truth`."""
    return truth()


@pytest.fixture(scope="session")
def bench(truth_model: DynamicModel, tmp_path_factory: pytest.TempPathFactory) -> Bench:
    structure = truth_model.structure
    return Bench(structure.chain, structure, truth_model, tmp_path_factory.mktemp("sessions"))


@pytest.fixture
def estimated(truth_model: DynamicModel) -> Callable[..., DynamicModel]:
    """A model with parameters scattered about the truth by their stated standard deviations."""

    def build(seed: int = 0, scale: float = 0.01, **changes: object) -> DynamicModel:
        rng = np.random.default_rng(seed)
        std = scale * np.maximum(np.abs(truth_model.values), 0.02)
        return DynamicModel(
            robot=truth_model.robot,
            structure=truth_model.structure,
            names=truth_model.names,
            values=truth_model.values + std * rng.normal(size=len(std)),
            covariance=np.diag(std**2),
            base=truth_model.base,
            **changes,  # type: ignore[arg-type]
        )

    return build
