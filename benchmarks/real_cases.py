"""Findings and gains of the diagnosis on published recordings of real arms; printed by
`python -m benchmarks.real_data`.

The arms of `benchmarks.real_arms`, and two more. TX40: motor torques of six joints at 5 kHz (github
thanhndv212/figaroh-examples). iiwa 14: constant-velocity sweeps of one joint, torque sensors (github
HarvardAgileRoboticsLab/drake).
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.real_arms import ARMS, low_passed_error
from fri.errors import LwrError
from ident.diagnosis import ArmData, Diagnosis, diagnose
from ident.dynamics.kinematics import Chain
from ident.dynamics.structure import Coupling
from ident.import_log import LogMapping, import_log
from lwr_driver.arm import Arm
from lwr_driver.session import Session, read_session
from tests.archives import unpack

__all__ = ["iiwa14", "tx40", "unseen"]

_SWEEPS = {
    "joint 4, 0.2 rad/s": ("joint4/vel_p2",),
    "joint 5, 0.3 rad/s": ("joint5/vel_p3",),
    "joint 6, 0.2, 0.5 and 0.9 rad/s": ("joint6/vel_p2", "joint6/vel_p5", "joint6/vel_p9"),
}


def unseen(data: Path) -> Iterator[tuple[str, str, Diagnosis]]:
    """Every arm of `benchmarks.real_arms` diagnosed with the defaults, measured on a motion that it has not seen: name
    of the arm, of that motion, and the diagnosis, already printed.

    The LWR4+ has the stiffness and the gear ratios of its file, the others those of none.
    """
    for arm in ARMS:
        folder = data / arm.folder
        if not folder.is_dir():
            print(f"\n{arm.title}: no recordings in {folder}")
            continue
        ours = Arm.load("lwr4plus.yaml")
        chain = Chain.from_urdf(folder / arm.urdf if arm.urdf else ours.urdf)
        known = None if arm.urdf else ArmData(ours.stiffness, ours.gear_ratio.astype(float))
        sessions = arm.read(folder, chain)
        for train, test in arm.splits:
            start = time.process_time()
            title = f"{arm.title}, {', '.join(train)}, measured on {test}"
            try:
                found = diagnose([sessions[name] for name in train], chain, test=[sessions[test]], arm=known)
            except LwrError as error:
                print(f"\n{title}: {type(error).__name__}: {error}")
                continue
            _show(title, found, start)
            for band in (2.0, 10.0):
                before, after = (
                    low_passed_error(m, sessions[test], band)
                    for m in (found.base_model, found.extended_model)
                )
                print(f"  relative error over all joints below {band:g} Hz: {before:.2f} % -> {after:.2f} %")
            yield arm.folder, test, found


def tx40(folder: Path) -> None:
    """One session, motor torques alone; parts of the motion held back in turn."""
    chain = Chain.from_urdf(folder / "tx40_mdh_modified.urdf")
    known = ArmData(couplings=(Coupling(("joint_5", "joint_6")),))
    start = time.process_time()
    found = diagnose([_imported("tx40", folder)], chain, arm=known)
    _show("TX40, parts of the motion held back in turn", found, start)


def iiwa14(folder: Path) -> None:
    """Sweeps of one joint; parts of the motion held back in turn."""
    chain = Chain.from_urdf(folder / "iiwa14.urdf")
    known = ArmData(gear_ratio=np.array([160.0, 160.0, 160.0, 160.0, 100.0, 160.0, 160.0]))
    with tempfile.TemporaryDirectory() as place:
        unpack(folder / "friction_sweeps_J4_J5_J6.tar.xz", Path(place))
        for title, names in _SWEEPS.items():
            start = time.process_time()
            sweeps = [_imported("iiwa14", Path(place) / "friction_model" / name) for name in names]
            _show(
                f"iiwa 14, {title}, parts of the motion held back in turn",
                diagnose(sweeps, chain, arm=known),
                start,
            )


def _imported(mapping: str, source: Path) -> Session:
    with tempfile.TemporaryDirectory() as folder:
        return read_session(
            import_log(LogMapping.load(mapping), source, Path(folder) / f"{source.name}.mcap").path
        )


def _show(title: str, found: Diagnosis, start: float) -> None:
    print(f"\n{title} (CPU {time.process_time() - start:.0f} s)")
    for broken in found.data:
        print(f"  broken: {broken}")
    for heading, claims in (("finding", found.findings), ("character", found.character)):
        for claim in claims:
            print(f"{heading}: {claim}")
    for term in found.nameless:
        print(
            f"  without a name: {term.side} torque of joint {term.joint} depends on {', '.join(term.depends_on)} "
            f"({term.test_rms_before:.3g} -> {term.test_rms_after:.3g} Nm)"
        )
    for rest in found.unexplained:
        print(
            f"  unexplained: {rest.side} torque of joint {rest.joint} depends on {', '.join(rest.depends_on) or '-'} "
            f"({rest.test_rms:.3g} Nm, floor {rest.noise_floor:.3g} Nm)"
        )
    for note in found.notes:
        print(f"  note: {note}")
    for side in found.rms_base:
        tables: Sequence[tuple[str, Any]] = (
            ("floor", found.noise_floor[side]),
            ("base", found.rms_base[side]),
            ("extended", found.rms_extended[side]),
        )
        for name, values in tables:
            print(f"  {side:<6}{name:<9}" + "".join(f"{v:>9.4f}" for v in values) + "  Nm rms, held out")
