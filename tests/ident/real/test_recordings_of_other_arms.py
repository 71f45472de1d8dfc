"""Recordings published by others: import, and comparison with their results."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.dynamics.kinematics import Chain
from ident.dynamics.regressor import gravity_torque
from ident.dynamics.structure import Coulomb, Coupling
from ident.estimation.identification import Identification, IdentificationSettings
from ident.estimation.identify import identify
from ident.estimation.validate import validate
from ident.import_log import LogMapping, import_log
from ident.rows.filters import SignalSettings
from ident.rows.timebase import flag_outliers
from lwr_driver.configuration import CONFIGS
from lwr_driver.session import read_session
from tests.archives import unpack

DATA = CONFIGS.parents[1] / "shared" / "data"

# Published with the recording (FIGAROH examples, staubli_TX40/config/TX40_config.yaml).
TX40 = {
    "Fvl": (8.05, 5.53, 1.97, 1.11, 1.86, 0.65),
    "Fcl": (7.14, 8.26, 6.34, 2.48, 3.03, 0.282),
    "Ia": (0.362, 0.362, 0.0988, 0.0313, 0.0468, 0.0105),
}
TX40_COUPLING = {"Iam6": 0.00964, "fvm6": 0.616, "fcm6": 1.95}


def folder(name: str) -> Path:
    if not (DATA / name).is_dir():
        pytest.skip(f"the published recording {name} is not at {DATA / name}")
    return DATA / name


@pytest.fixture(scope="module")
def tx40(tmp_path_factory: pytest.TempPathFactory) -> Identification:
    """As its source did it: 100 Hz position filter, speeds below 1 % of the limit left out (0.05 rad/s).

    A row stays while half of its filter is on moving samples.
    """
    source = folder("tx40")
    path = tmp_path_factory.mktemp("tx40") / "tx40.mcap"
    import_log(LogMapping.load("tx40"), source, path)
    signals = SignalSettings(
        cutoff_hz=100.0,
        decimate_hz=50.0,
        standstill_rad_s=0.05,
        known_share=0.5,
        reversal_s=0.0,
    )
    settings = IdentificationSettings(
        model=2, couplings=(Coupling(("joint_5", "joint_6")),), signals=signals, coulomb=Coulomb()
    )
    return identify([read_session(path)], Chain.from_urdf(source / "tx40_mdh_modified.urdf"), settings)


def published_convention(found: Identification) -> tuple[dict[str, float], dict[str, float]]:
    """Values and standard deviations; the source lets fvm6 act on the other joint's speed alone.

    Ours acts on the sum of both in both rows, so the source's fv5 and fv6 are ours plus fvm6.
    """
    names = [name.rstrip("R") for name in found.base.names]
    mix = np.eye(len(names))
    for joint in (5, 6):
        mix[names.index(f"Fvl{joint}"), names.index("fvm6")] = 1.0
    values = mix @ found.estimate.values
    std = np.sqrt(np.diag(mix @ found.estimate.covariance.matrix @ mix.T))
    return dict(zip(names, values, strict=True)), dict(zip(names, std, strict=True))


def test_tx40_friction_and_drive_inertia_are_the_published_ones(tx40: Identification) -> None:
    values, std = published_convention(tx40)
    expected = {f"{symbol}{k + 1}": v for symbol, row in TX40.items() for k, v in enumerate(row)}
    expected |= TX40_COUPLING
    # Ia1 and Ia2 are regrouped into ZZ1 and ZZ2: motor torque alone cannot tell them apart.
    assert {name for name in expected if name not in values} == {"Ia1", "Ia2"}
    lines, bad = [], []
    for name, truth in expected.items():
        if name not in values:
            continue
        difference = values[name] - truth
        lines.append(
            f"{name:<6}{values[name]:>9.4f} ± {std[name]:<8.4f}{truth:>9.4f}"
            f"{100 * difference / truth:>8.1f} %{difference / std[name]:>7.1f} std"
        )
        if abs(difference) > max(0.05 * truth, 2.0 * std[name]):
            bad.append(name)
    print("\n".join(["parameter, estimate, published, difference", *lines]))
    assert not bad
    friction = [abs(values[f"{s}{k + 1}"] / v - 1) for s in ("Fvl", "Fcl") for k, v in enumerate(TX40[s][:5])]
    assert max(friction) < 0.02


def test_tx40_has_the_published_number_of_base_parameters(tx40: Identification) -> None:
    assert len(tx40.base) == 58 + 3
    assert {group.side for group in tx40.problem.groups} == {"motor"}


def test_no_torque_of_the_tx40_is_an_outlier(tx40: Identification) -> None:
    counts = tx40.prepared[0].counts
    assert counts["motor_torque_outliers"] == counts["position_outliers"] == 0


def test_spikes_in_a_torque_of_the_lwr4_are_outliers(tmp_path: Path) -> None:
    """Three hundredths of the range are enough; beside them, on steep slopes, a neighbour may go too."""
    with np.load(folder("lwr4_flobaroid") / "measurements_3.npz") as raw:
        torque = np.array(raw["torques"])
    assert not flag_outliers(torque, 8.0)[0].any()
    places = np.random.default_rng(1).choice(len(torque) // 20, 40, replace=False) * 20 + 7
    torque[places] += 0.03 * np.ptp(torque, axis=0)
    flags, crowded = flag_outliers(torque, 8.0)
    assert crowded == []
    assert flags[places].all()
    assert np.abs(np.flatnonzero(flags.any(axis=1))[:, None] - places).min(axis=1).max() <= 2
    assert flags.sum() < 1.1 * flags[places].size


def test_lwr4_runs_arrive_whole(tmp_path: Path) -> None:
    source = folder("lwr4_flobaroid") / "measurements_1.npz"
    report = import_log(LogMapping.load("lwr4_flobaroid"), source, tmp_path / "run.mcap")
    session = read_session(report.path)
    with np.load(source) as raw:
        np.testing.assert_array_equal(session.joint.position, raw["positions"])
        np.testing.assert_array_equal(session.joint.effort, raw["torques"])
        np.testing.assert_array_equal(session.joint.velocity, raw["velocities"])
        times: NDArray[np.float64] = raw["times"]
    assert session.command is None
    np.testing.assert_allclose(np.diff(session.joint.log_time) * 1e-9, np.diff(times), atol=3e-7)
    assert session.metadata["utc_start"].startswith("2016-04-07")
    assert 3e-3 < report.shortest_s < report.longest_s < 7e-3


def test_lwr4_repeat_is_predicted_and_another_trajectory_less_so(tmp_path: Path) -> None:
    """A model of run 1 predicts its repeat, run 2, far better than run 3, another trajectory."""
    source = folder("lwr4_flobaroid")
    chain = Chain.from_urdf(source / "kuka_lwr4_2016-04-11.urdf")
    mapping = dataclasses.replace(LogMapping.load("lwr4_flobaroid"), joints=chain.joint_names)
    sessions = []
    for number in (1, 2, 3):
        path = tmp_path / f"run_{number}.mcap"
        import_log(mapping, source / f"measurements_{number}.npz", path, urdf=chain.urdf)
        sessions.append(read_session(path))
    found = identify(sessions[:1], chain, IdentificationSettings(model=1))
    result = validate(found.model, sessions[1:])
    repeat, other = (score.relative["joint"] for score in result.scores)
    assert repeat < 0.03
    assert 0.08 < other < 0.25


def test_iiwa_torque_has_the_sign_of_gravity_and_the_loop_of_friction(tmp_path: Path) -> None:
    data = folder("iiwa14")
    unpack(data / "friction_sweeps_J4_J5_J6.tar.xz", tmp_path)
    sweep = tmp_path / "friction_model" / "joint4" / "vel_p2"
    session = read_session(import_log(LogMapping.load("iiwa14"), sweep, tmp_path / "sweep.mcap").path)
    chain = Chain.from_urdf(data / "iiwa14.urdf")
    joint = session.select(chain.joint_names).joint
    assert np.corrcoef(np.gradient(joint.position[:, 3], 0.005), joint.velocity[:, 3])[0, 1] > 0.95
    gravity = gravity_torque(chain, joint.position, chain.urdf_inertials())
    assert np.corrcoef(gravity[:, 3], joint.effort[:, 3])[0, 1] > 0.98
    rest, speed = (joint.effort - gravity)[:, 3], joint.velocity[:, 3]
    assert 0.2 < np.median(rest[speed > 0.1]) - np.median(rest[speed < -0.1]) < 2.0
