"""Positions, speeds and torques against the limits of the URDF."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence

import numpy as np

from ident.dynamics.kinematics import Chain
from ident.screening.doubts import Doubt, torques_of
from lwr_driver.session import Session

# Overshoot of a limit by calibration, over which a doubt is raised, and share of the samples left out as outliers.
_OVER, _OUTLIERS = 1.1, 0.001


def check_limits(sessions: Sequence[Session], chain: Chain) -> list[Doubt]:
    """Doubts by the limits in the URDF: a channel is wrong, seldom clear how."""
    limits, found = joint_limits(chain), list[Doubt]()
    units = dict(zip(chain.joint_names, chain.torque_units, strict=True))
    for session in sessions:
        beyond = list(_limits(session, limits, units))
        # A position in another unit is too fast as well.
        named = {name for doubt in beyond if doubt.channel == "position" for name in doubt.joints}
        rest = {name: limit for name, limit in limits.items() if name not in named}
        found += [*beyond, *_pace(session, rest)]
    return found


def joint_limits(chain: Chain) -> dict[str, dict[str, float]]:
    """`lower`, `upper`, `velocity`, `effort` of the joints in the URDF of `chain`, as far as they are limits."""
    if chain.urdf is None:
        return {}
    found: dict[str, dict[str, float]] = {}
    for joint in ElementTree.fromstring(chain.urdf).findall("joint"):
        limit = joint.find("limit")
        if limit is None or joint.get("name", "") not in chain.joint_names:
            continue
        values: dict[str, float] = {}
        for key in ("lower", "upper", "velocity", "effort"):
            try:
                values[key] = float(limit.get(key, "nan"))
            except ValueError:
                values[key] = float("nan")
        if joint.get("type") == "continuous" or not values["upper"] > values["lower"]:
            del values["lower"], values["upper"]
        found[joint.get("name", "")] = {
            k: v for k, v in values.items() if np.isfinite(v) and (v > 0 or k in ("lower", "upper"))
        }
    return found


def _limits(session: Session, limits: dict[str, dict[str, float]], units: dict[str, str]) -> Iterator[Doubt]:
    """Positions and torques against the limits of the URDF."""
    name, joint = session.path.name, session.joint
    for k, own in enumerate(session.joint_names):
        limit = limits.get(own, {})
        if "lower" in limit and len(joint):
            low, high = np.quantile(joint.position[:, k], [_OUTLIERS, 1.0 - _OUTLIERS])
            middle, half = 0.5 * (limit["lower"] + limit["upper"]), 0.5 * (limit["upper"] - limit["lower"])
            over = max(high - middle, middle - low) / half
            if over > _OVER:
                degrees = np.radians(1.0) * max(high - middle, middle - low) < 1.1 * half and over > 3.0
                seen = f"ranges from {low:.4g} to {high:.4g}, beyond "
                seen += f"{limit['lower']:.4g} to {limit['upper']:.4g} of the URDF"
                looks = "degrees for radians" if degrees else "another zero, unit or joint"
                yield Doubt(
                    "position", (own,), seen, looks, "state unit and offset when importing", degrees, name
                )
        for channel, columns in torques_of(session):
            if limit.get("effort", 0.0) > 0.0:
                size = float(np.quantile(np.abs(columns.effort[:, k]), 1.0 - _OUTLIERS))
                over = size / limit["effort"]
                if over > 3.0:
                    unit = units.get(own, "Nm")
                    seen = f"reaches {size:.4g} {unit}, {over:.3g} times the limit of the URDF"
                    looks = f"m{unit} for {unit}, or a gain" if over > 100.0 else "a unit or gain"
                    yield Doubt(
                        channel, (own,), seen, looks, "state the unit when importing", over > 100.0, name
                    )


def _pace(session: Session, limits: dict[str, dict[str, float]]) -> Iterator[Doubt]:
    """Speeds of all joints against the limits of the URDF: a wrong unit of time or position makes all too fast."""
    joint = session.joint
    if len(joint) < 100:
        return
    clock = joint.publish_time if np.ptp(joint.publish_time) > 0 else joint.log_time
    time = (clock - clock[0]) * 1e-9
    step = max(1, len(time) // 500)
    speed = (
        np.abs(np.diff(joint.position[::step], axis=0)) / np.maximum(np.diff(time[::step]), 1e-12)[:, None]
    )
    own = [limits.get(name, {}).get("velocity", np.inf) for name in session.joint_names]
    over = float(np.max(np.quantile(speed, 0.9, axis=0) / np.array(own)))
    if over > 3.0:
        seen = f"the joints move at up to {over:.3g} times their speed limits of the URDF"
        looks = "a unit of time too large, such as minutes for seconds, or positions in a unit too small"
        mend = "state the units of time and position when importing"
        yield Doubt("time", (), seen, looks, mend, over > 10.0, session.path.name)
