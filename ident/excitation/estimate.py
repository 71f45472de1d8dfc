"""What is known of the arm's dynamics when a motion is planned: parameter values, their uncertainty, the
noise.

Planning needs them three times: torques for the torque limits (with their uncertainty), values for the
predicted relative standard deviations, noise for the weights of the rows. After each re-identification the
new estimate replaces the old.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fri.errors import ConfigurationError
from ident.dynamics import parameters
from ident.dynamics.parameters import DRIVE, INERTIAL
from ident.excitation.mechanism import Mechanism
from ident.excitation.motion import Array
from ident.model.dynamic_model import DynamicModel
from lwr_driver.configuration import read_mapping

__all__ = ["BODY", "DRIVE", "ArmEstimate", "Noise", "split_name"]

BODY = INERTIAL


def split_name(name: str) -> tuple[str, int]:
    """Kind and link of a parameter name: `ZZ2R` is ("ZZ", 2). The `R` of a regrouped parameter is dropped."""
    kind, link, _ = parameters.split_name(name)
    if kind not in parameters.PER_LINK or link < 1:
        raise ConfigurationError(f"parameter name {name!r} is unknown; names look like ZZ2R, MY8 or Fvm3")
    return kind, link


@dataclass(frozen=True, eq=False)
class Noise:
    """Standard deviation of the torque rows, and how many independent samples a session gives.

    motor, joint (n,): [Nm]; samples: independent samples (after decimation) in one session of the planned
    motion.
    """

    motor: Array
    joint: Array
    samples: float = 100.0

    def __post_init__(self) -> None:
        for name in ("motor", "joint"):
            values = np.array(getattr(self, name), dtype=np.float64)
            if values.ndim != 1 or not np.all(values > 0) or not np.all(np.isfinite(values)):
                raise ConfigurationError(
                    f"noise of the {name} rows is {values}; one positive number per joint is needed"
                )
            object.__setattr__(self, name, values)
        if not self.samples > 0:
            raise ConfigurationError(f"noise: {self.samples} samples; at least one is needed")

    @classmethod
    def published(cls) -> Noise:
        """Row noise that explains the published relative deviations of Table 2: 5 Hz after decimation, 100
        samples.
        """
        return cls(
            motor=np.array([1.05, 2.04, 0.78, 1.44, 0.83, 0.46, 0.25]),
            joint=np.array([0.28, 0.12, 0.06, 0.11, 0.11, 0.11, 0.36]),
        )


@dataclass(frozen=True, eq=False)
class ArmEstimate:
    """Present values of the standard parameters.

    bodies (n, 10): XX XY XZ YY YZ ZZ MX MY MZ M of each link in its own frame
    drives (n, 7): Ia Fvl Fcl offl Fvm Fcm offm of each joint
    payload (10,): the payload in the last frame, None where every session is unloaded
    covariance_names, covariance: uncertainty of (base) parameters by name, (p, p); empty where none is known
    noise: row noise for weights and predicted deviations
    """

    bodies: Array
    drives: Array
    payload: Array | None = None
    covariance_names: tuple[str, ...] = ()
    covariance: Array | None = None
    noise: Noise | None = None

    def __post_init__(self) -> None:
        n = self.bodies.shape[0]
        if self.bodies.shape != (n, 10) or self.drives.shape != (n, 7):
            raise ConfigurationError(
                f"estimate with bodies {self.bodies.shape} and drives {self.drives.shape}; "
                "expected (n, 10) and (n, 7)"
            )
        if self.covariance is not None:
            p = len(self.covariance_names)
            if self.covariance.shape != (p, p):
                raise ConfigurationError(f"covariance of shape {self.covariance.shape} for {p} parameters")

    @property
    def joints(self) -> int:
        """Number of joints."""
        return int(self.bodies.shape[0])

    @property
    def loads(self) -> Array:
        """Body parameters of each load case, unloaded first, (1 or 2, n, 10)."""
        if self.payload is None:
            return self.bodies[None].copy()
        loaded = self.bodies.copy()
        loaded[-1] += self.payload
        return np.stack([self.bodies, loaded])

    def value(self, name: str) -> float:
        """Standard parameter by name; link n + 1 is the payload."""
        kind, link = split_name(name)
        if kind in DRIVE and 1 <= link <= self.joints:
            return float(self.drives[link - 1, DRIVE.index(kind)])
        if kind in BODY and 1 <= link <= self.joints:
            return float(self.bodies[link - 1, BODY.index(kind)])
        if kind in BODY and link == self.joints + 1 and self.payload is not None:
            return float(self.payload[BODY.index(kind)])
        raise ConfigurationError(
            f"parameter {name} does not exist in an arm of {self.joints} joints with this payload"
        )

    def with_relative_uncertainty(self, fraction: float) -> ArmEstimate:
        """The same values, each parameter independently uncertain by a fraction of itself (one standard
        deviation).
        """
        if not 0.0 <= fraction < 1.0:
            raise ConfigurationError(f"relative uncertainty {fraction} is outside 0 to 1")
        names = self.standard_names()
        sigma = fraction * np.array([self.value(name) for name in names])
        keep = np.abs(sigma) > 0.0
        kept = tuple(name for name, use in zip(names, keep, strict=True) if use)
        if not kept:
            return replace(self, covariance_names=(), covariance=None)
        return replace(self, covariance_names=kept, covariance=np.diag(sigma[keep] ** 2))

    def standard_names(self) -> tuple[str, ...]:
        """Names of all standard parameters that this estimate has values for."""
        links = self.joints + (self.payload is not None)
        body = [f"{kind}{link}" for link in range(1, links + 1) for kind in BODY]
        return tuple(body + [f"{kind}{link}" for link in range(1, self.joints + 1) for kind in DRIVE])

    @classmethod
    def nominal(cls, mechanism: Mechanism, payload: Array | None = None) -> ArmEstimate:
        """The URDF's inertias, no friction, no drive inertia: what is known before the first experiment."""
        return cls(mechanism.bodies.copy(), np.zeros((mechanism.joints, 7)), payload)

    @classmethod
    def from_model(
        cls, model: DynamicModel, payload: str | None = None, noise: Noise | None = None
    ) -> ArmEstimate:
        """Values and covariance of an identified model, with one of its payloads mounted.

        After each re-identification this closes the loop: plan, estimate, plan again.
        """
        joints = model.structure.chain.n
        bodies = model.inertial(None)
        load = None if payload is None else model.inertial(payload)[-1] - bodies[-1]
        drives = np.column_stack([model.drive()[kind] for kind in DRIVE])
        names: tuple[str, ...] = ()
        covariance = None
        if model.covariance is not None:
            last = None if payload is None else model.structure.payload_link(payload)
            keep, renamed = [], []
            for index, name in enumerate(model.names):
                kind, link = split_name(name)
                if link <= joints or (last is not None and link == last + 1):
                    keep.append(index)
                    renamed.append(f"{kind}{min(link, joints + 1)}")
            names, covariance = tuple(renamed), model.covariance[np.ix_(keep, keep)]
        return cls(bodies, drives, load, names, covariance, noise)

    @classmethod
    def from_file(cls, path: Path, joints: int, payload: str | None = None) -> ArmEstimate:
        """Read `parameters` (name: value) and `payloads` from a YAML file, such as the emulator's true
        parameters.
        """
        content = read_mapping(path)
        values = content.get("parameters")
        if not isinstance(values, dict):
            raise ConfigurationError(
                f"{path}: key `parameters` is missing; it maps names such as ZZ2 to values"
            )
        bodies, drives = np.zeros((joints, 10)), np.zeros((joints, 7))
        for name, value in values.items():
            kind, link = split_name(str(name))
            if not 1 <= link <= joints:
                raise ConfigurationError(
                    f"{path}: parameter {name} belongs to link {link}, the arm has {joints}"
                )
            value = _number(value, f"{path}: parameter {name}")
            if kind in BODY:
                bodies[link - 1, BODY.index(kind)] = value
            else:
                drives[link - 1, DRIVE.index(kind)] = value
        load = None
        if payload is not None:
            payloads = content.get("payloads") or {}
            if payload not in payloads:
                known = ", ".join(payloads) or "none"
                raise ConfigurationError(f"{path}: payload {payload!r} is not in `payloads`; known: {known}")
            entries = payloads[payload]
            load = np.array([_number(entries.get(kind, 0.0), f"{path}: payload {payload}") for kind in BODY])
        return cls(bodies, drives, load)


def _number(value: object, where: str) -> float:
    """A finite number; YAML reads `1e-05` (no dot) as text, which is meant as a number here."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        number = np.nan
    if isinstance(value, bool) or not np.isfinite(number):
        raise ConfigurationError(f"{where} is {value!r}, not a finite number")
    return number
