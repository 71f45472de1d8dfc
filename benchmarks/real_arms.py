"""Recordings of real arms that others published: the command `lwr-run identify` as it comes, and a motion that it has
not seen; printed by `python -m benchmarks.real_data`.

Nothing is set but what the files need: names, units and columns of their channels. Model 1 where no motor torque was
recorded. Sources: LWR4+ github kjyv/FloBaRoID, xMate ER7 Pro github NKU-ZiXuan/xMate7p_dyn_ident, Panda github
marcocognetti/FrankaEmikaPandaDynModel, Kinova Gen3 github wissem01chiha/dynamic-identification.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fri.errors import LwrError
from ident.dynamics.kinematics import Chain
from ident.estimation.identification import Identification, IdentificationSettings
from ident.estimation.identify import identify
from ident.estimation.validate import validate
from ident.estimators.names import AUTO
from ident.import_log import LogMapping, import_log
from ident.import_log.mapping import Signal, TimeBase
from ident.model.dynamic_model import DynamicModel
from ident.rows.filters import differentiate, low_pass
from ident.rows.sample_clock import sample_clock
from lwr_driver.configuration import find
from lwr_driver.session import Session, read_session

__all__ = ["ARMS", "RealArm", "defaults", "low_passed_error"]

Floats = NDArray[np.float64]

# Bands in which both torques are compared [Hz], and the periods of the band's edge left out at each end.
_BAND_HZ = (2.0, 10.0)
_END_PERIODS = 3.0


@dataclass(frozen=True)
class RealArm:
    """A published recording. folder : below the data. urdf : of the arm. splits : training and test files.

    read : sessions by name of a recording. model : 1 or 2.
    """

    title: str
    folder: str
    urdf: str
    splits: tuple[tuple[tuple[str, ...], str], ...]
    read: Callable[[Path, Chain], dict[str, Session]]
    model: int = 1


def defaults(data: Path) -> None:
    """Error on unseen motion, time from files to result and all messages, of every arm and split."""
    print("Real arms, `lwr-run identify` as it comes: error on a motion not seen")
    for arm in ARMS:
        folder = data / arm.folder
        if not folder.is_dir():
            print(f"\n{arm.title}: no recordings in {folder}")
            continue
        chain = Chain.from_urdf(find("lwr4plus.urdf") if not arm.urdf else folder / arm.urdf)
        with _timed() as import_s:
            sessions = arm.read(folder, chain)
        for train, test in arm.splits:
            print(f"\n{arm.title}, {{{', '.join(train)}}} -> {test}")
            _split(arm, chain, sessions, train, test, import_s() / len(sessions))


def _split(
    arm: RealArm,
    chain: Chain,
    sessions: dict[str, Session],
    train: tuple[str, ...],
    test: str,
    import_s: float,
) -> None:
    logs = [sessions[name] for name in train]
    for estimator in (AUTO, "wls", "physical"):
        settings = IdentificationSettings(model=arm.model, estimator=estimator, essential=None)
        try:
            with _timed() as spent:
                found = identify(logs, chain, settings)
        except LwrError as error:
            print(f"  {estimator:<9} {type(error).__name__}: {error}")
            continue
        duration = spent() + import_s * len(train)
        print(f"  {estimator:<9}{_errors(found, sessions[test])}; {duration:.1f} s from files to result")
        if estimator == AUTO:
            _messages(found)


def _errors(found: Identification, test: Session) -> str:
    try:
        figures = validate(found.model, [test]).scores[0].relative
        text = "all samples: " + ", ".join(f"{side} {100 * value:.2f} %" for side, value in figures.items())
    except LwrError as error:
        text = f"validate: {error}"
    if test.joint.effort.shape[1]:
        for band in _BAND_HZ:
            figure = low_passed_error(found.model, test, band)
            text += "" if np.isnan(figure) else f", below {band:g} Hz: {figure:.2f} %"
    return text


def _messages(found: Identification) -> None:
    for line in str(found.choice).splitlines():
        print(f"    {line}")
    for warning in found.warnings:
        print(f"    warning: {warning}")


def low_passed_error(model: DynamicModel, session: Session, band_hz: float) -> float:
    """Relative error [%] of the joint torque over all joints, position and both torques low-passed alike.

    NaN for a session of six periods of the band's edge or less.
    """
    joint = session.joint
    times = 1e-9 * (joint.log_time - joint.log_time[0]).astype(np.float64)
    fresh = np.append(True, np.diff(times) > 0.0)
    clock = sample_clock(times, joint.position)
    if clock is not None:
        times, fresh = clock.times, ~clock.repeated
    dt = float(np.median(np.diff(times[fresh])))
    even = np.arange(times[-1], step=dt)
    chosen = session.select(model.structure.chain.joint_names).joint
    q, torque = (
        np.column_stack([np.interp(even, times[fresh], column[fresh]) for column in values.T])
        for values in (chosen.position, chosen.effort)
    )
    q = low_pass(q, dt, band_hz)
    computed = model.torque(q, *differentiate(q, dt), side="joint", time=even, measured=True)
    torque, computed = low_pass(torque, dt, band_hz), low_pass(computed, dt, band_hz)
    if even[-1] <= 2.0 * _END_PERIODS / band_hz:
        return float("nan")
    end = round(_END_PERIODS / band_hz / dt)
    inner = slice(end, len(even) - end)
    return 100.0 * float(np.linalg.norm((torque - computed)[inner]) / np.linalg.norm(torque[inner]))


@contextmanager
def _timed() -> Iterator[Callable[[], float]]:
    start = time.perf_counter()
    end = [0.0]
    yield lambda: end[0]
    end[0] = time.perf_counter() - start


def _imported(mapping: LogMapping, source: Path) -> Session:
    with tempfile.TemporaryDirectory() as folder:
        return read_session(import_log(mapping, source, Path(folder) / f"{source.stem}.mcap").path)


def _lwr4(folder: Path, chain: Chain) -> dict[str, Session]:
    mapping = LogMapping.load("lwr4_flobaroid")
    return {str(run): _imported(mapping, folder / f"measurements_{run}.npz") for run in (1, 2, 3)}


def _xmate(folder: Path, chain: Chain) -> dict[str, Session]:
    mapping = LogMapping(
        robot="ROKAE xMate ER7 Pro",
        joints=chain.joint_names,
        time=TimeBase(rate_hz=50.0),
        position=Signal("rad", columns=tuple(range(1, 8))),
        velocity=Signal("rad/s", columns=tuple(range(8, 15))),
        joint_torque=Signal("Nm", columns=tuple(range(22, 29))),
        header=False,
    )
    return {str(run): _imported(mapping, folder / f"t{run}.csv") for run in (1, 2, 3)}


def _numbered(name: str) -> tuple[str, ...]:
    return tuple(f"{name}{k}" for k in range(1, 8))


def _panda(folder: Path, chain: Chain) -> dict[str, Session]:
    """The first two thirds and the last third of the recording."""
    mapping = LogMapping(
        robot="Franka Panda",
        joints=chain.joint_names,
        time=TimeBase(column="t"),
        position=Signal("rad", columns=_numbered("q")),
        velocity=Signal("rad/s", columns=_numbered("dq")),
        joint_torque=Signal("Nm", columns=_numbered("tau")),
    )
    head, *rows = (folder / "panda.csv").read_text().splitlines()
    times = np.array([float(row.split(",")[0]) for row in rows])
    cut = int(np.searchsorted(times, times[0] + 2.0 / 3.0 * np.ptp(times)))
    sessions = {}
    with tempfile.TemporaryDirectory() as place:
        for name, part in (("two thirds", rows[:cut]), ("one third", rows[cut:])):
            source = Path(place) / f"{name.replace(' ', '_')}.csv"
            source.write_text("\n".join([head, *part]) + "\n")
            sessions[name] = _imported(mapping, source)
    return sessions


def _kinova(folder: Path, chain: Chain) -> dict[str, Session]:
    mapping = LogMapping(
        robot="Kinova Gen3",
        joints=chain.joint_names,
        time=TimeBase(column="Time", unit="ms"),
        position=Signal("rad", columns=_numbered("Position")),
        velocity=Signal("rad/s", columns=_numbered("Velocity")),
        joint_torque=Signal("Nm", columns=_numbered("TorqueSm")),
        motor_torque=Signal("Nm", columns=_numbered("TorqueCur")),
    )
    names = {"testing 1": "opti_traj_testing1", "testing 2": "opti_traj_testing2"}
    return {name: _imported(mapping, folder / f"{file}.csv") for name, file in names.items()}


_BOTH = ((("1", "2"), "3"), (("3",), "1"))
_KINOVA = ((("testing 1",), "testing 2"), (("testing 2",), "testing 1"))
ARMS = (
    RealArm("LWR4+", "lwr4_flobaroid", "", _BOTH, _lwr4),
    RealArm("xMate ER7 Pro", "xmate7p", "XM7p.urdf", _BOTH, _xmate),
    RealArm("Panda", "panda_gaz", "panda_arm.urdf", ((("two thirds",), "one third"),), _panda),
    RealArm("Kinova Gen3, joint torque", "kinova_gen3", "gen3.urdf", _KINOVA, _kinova),
    RealArm("Kinova Gen3, both torques", "kinova_gen3", "gen3.urdf", _KINOVA[:1], _kinova, model=2),
)
"""The arms of the comparison."""
