"""The zero of an elbow that nothing but the URDF's gravity tells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import INERTIAL, Floats
from ident.dynamics.regressor import rigid_regressor, torque
from ident.screening.zeros import zero_by_gravity


def planar() -> Chain:
    """Three links of 0.4 m in a vertical plane that the first joint turns."""
    links, joints = '<link name="base"/>', ""
    for k, (axis, far) in enumerate((("0 0 1", 0.0), ("0 1 0", 0.0), ("0 1 0", 0.4), ("0 1 0", 0.4))):
        body = (
            f'<inertial><origin xyz="0.2 0 0.01"/><mass value="{6 - k}"/>'
            '<inertia ixx="0.02" iyy="0.05" izz="0.05" ixy="0" ixz="0" iyz="0"/></inertial>'
        )
        links += f'<link name="l{k}">{body}</link>'
        joints += (
            f'<joint name="j{k}" type="revolute"><parent link="{f"l{k - 1}" if k else "base"}"/><child link="l{k}"/>'
            f'<origin xyz="{far} 0 0"/><axis xyz="{axis}"/>'
            '<limit lower="-3" upper="3" velocity="2" effort="99"/></joint>'
        )
    return Chain.from_urdf(f'<robot name="planar">{links}{joints}</robot>')


def identified(chain: Chain, recorded: Floats, measured: Floats) -> Floats:
    """Bodies of torques (N, n) at the recorded poses."""
    still = np.zeros_like(recorded)
    columns = rigid_regressor(chain, recorded, still, still)
    return np.linalg.lstsq(columns.reshape(-1, columns.shape[2]), measured.T.ravel(), rcond=None)[0]


def test_the_zero_of_an_elbow_shows_against_the_gravity_of_the_urdf() -> None:
    chain = planar()
    q = np.random.default_rng(3).uniform(-1.4, 1.4, (80, 4))
    still, nominal = np.zeros_like(q), chain.urdf_inertials()
    for joint, degrees in ((2, 9.0), (1, -7.0)):
        recorded = q.copy()
        recorded[:, joint] += np.radians(degrees)
        # Masses of a URDF are seldom right.
        bodies = identified(chain, recorded, 1.1 * torque(chain, q, still, still, nominal))
        found = zero_by_gravity(chain, recorded, bodies, nominal)
        assert found is not None
        assert found.joint == joint
        assert np.degrees(found.size) == pytest.approx(degrees, abs=0.1)
        assert found.after < 0.01 < found.before
    assert zero_by_gravity(chain, q, 1.1 * nominal.ravel(), nominal) is None
    # Of a base without gravity along its joints nothing is told.
    assert zero_by_gravity(replace(chain, gravity=np.zeros(3)), q, nominal.ravel(), nominal) is None


@pytest.mark.parametrize(
    ("lever_m", "degrees", "told"), [(0.03, 16.0, False), (0.3, 16.0, True), (0.3, 28.6, False)]
)
def test_a_short_lever_tells_no_zero_that_a_misplaced_centre_of_mass_is(
    lever_m: float, degrees: float, told: bool
) -> None:
    """At 3 cm from the wrist's axis 8 mm are 16 degrees; and a least at the end of the range is none."""
    chain = planar()
    q = np.random.default_rng(3).uniform(-1.4, 1.4, (80, 4))
    still, stated = np.zeros_like(q), chain.urdf_inertials().reshape(4, 10).copy()
    stated[3, [INERTIAL.index("MX"), INERTIAL.index("M")]] = 4.0 * lever_m, 4.0
    recorded = q.copy()
    recorded[:, 3] += np.radians(degrees)
    bodies = identified(chain, recorded, torque(chain, q, still, still, stated))
    assert (zero_by_gravity(chain, recorded, bodies, stated) is not None) == told
