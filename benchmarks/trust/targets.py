"""What the fuzzers feed: each target takes bytes and returns, or raises an error of ours.

Anything else that leaves a target is a fault: another exception, a hang, memory without bound.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType

import numpy as np

from benchmarks.trust.stand import START, the_arm
from fri.errors import LwrError
from fri.krc import KrcSession, Sample
from fri.packets import CMD_SIZE, MSR_SIZE, MsrBuffer
from fri.policy import KrcLimits, KrcPolicy
from fri.sequence import SequenceTracker
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell
from lwr_driver.session import read_session, recover

__all__ = ["TARGETS", "check", "corpus"]

_ROOT = Path(__file__).resolve().parents[2]


@cache
def _folder() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="trust-"))
    import atexit
    import shutil

    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def measurement(data: bytes) -> None:
    """Datagrams at the PC, and what their counters say."""
    buffer, tracker = MsrBuffer(), SequenceTracker()
    for start in range(0, max(len(data), 1), MSR_SIZE):
        part = data[start : start + MSR_SIZE]
        buffer.buffer[: len(part)] = part
        if buffer.fault(len(part)) is None:
            tracker.feed(buffer.send_seq, buffer.timestamp, buffer.sample_time)
            assert np.isfinite(buffer.cmd_jnt_pos).all()


def command(data: bytes) -> None:
    """Datagrams at the controller in command mode: the set point stays finite and inside the limits."""
    arm = the_arm()
    limits = KrcLimits(arm.q_min, arm.q_max, arm.v_max, np.full(7, 20.0))
    session = KrcSession(limits, START, KrcPolicy(window=4, minimum_packets=1, start_dwell=0))
    session.fri_open(5)
    for start in range(0, max(len(data), 1), CMD_SIZE):
        part = bytearray(data[start : start + CMD_SIZE])
        packet = session.packet(Sample())
        if len(part) >= 4:
            part[2:4] = packet[:2]
        session.receive(bytes(part))
        setpoint = session.close_cycle().position
        assert np.isfinite(setpoint).all()
        assert np.all(setpoint >= arm.q_min - 1e-5)
        assert np.all(setpoint <= arm.q_max + 1e-5)
        session.fri_start(1.0)


def session_log(data: bytes) -> None:
    """A log that is read, and made whole."""
    path, whole = _folder() / "log.mcap", _folder() / "whole.mcap"
    path.write_bytes(data)
    whole.unlink(missing_ok=True)
    session = read_session(path)
    assert np.isfinite(session.joint.position).all()
    recover(path, whole)
    assert len(read_session(whole).joint) == len(session.joint)


def _file(name: str, data: bytes) -> Path:
    path = _folder() / name
    path.write_bytes(data)
    return path


def experiment(data: bytes) -> None:
    """An experiment file."""
    from runner.experiment_file import Experiment

    loaded = Experiment.load(_file("experiment.yaml", data))
    assert "/" not in loaded.name
    for session in loaded.sessions:
        assert "/" not in session.name
        assert ".." not in session.name


def arm(data: bytes) -> None:
    """The description of an arm."""
    (_folder() / "lwr4plus.urdf").write_bytes((_ROOT / "configs/lwr4plus.urdf").read_bytes())
    loaded = Arm.load(_file("arm.yaml", data))
    assert np.isfinite(loaded.q_max).all()


def cell(data: bytes) -> None:
    """The description of a cell."""
    Cell.load(_file("cell.yaml", data))


def emulator(data: bytes) -> None:
    """The configuration of the emulator."""
    from sim_backend.configuration import load_configuration

    load_configuration(_file("emulator.yaml", data))


def urdf(data: bytes) -> None:
    """A robot description."""
    from ident.dynamics.kinematics import Chain

    try:
        text = data.decode()
    except UnicodeDecodeError:
        return
    Chain.from_urdf(text)


def mapping(data: bytes) -> None:
    """The mapping of an import."""
    from ident.import_log import LogMapping

    LogMapping.load(str(_file("mapping.yaml", data)))


TARGETS: Mapping[str, Callable[[bytes], None]] = MappingProxyType(
    {
        target.__name__: target
        for target in (measurement, command, session_log, experiment, arm, cell, emulator, urdf, mapping)
    }
)


def check(name: str, data: bytes) -> str:
    """`ok`, `refused` (an error of ours), or what else came out."""
    try:
        TARGETS[name](data)
    except LwrError:
        return "refused"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return "ok"


def _packets(size: int) -> bytes:
    from fri.packets import new_cmd, new_msr

    rows = []
    for number in range(6):
        row = new_msr() if size == MSR_SIZE else new_cmd()
        row["send_seq"] = number
        if size == MSR_SIZE:
            row["msr_sample_time"] = row["cmd_sample_time"] = 0.005
            row["timestamp"], row["state"] = 0.005 * number, 1
        else:
            row["cmd_flags"], row["jnt_pos"] = 1, START
        rows.append(row.tobytes())
    return b"".join(rows)


@cache
def _log() -> bytes:
    from benchmarks.trust.stand import Stand, shared_ring

    with shared_ring() as ring, Stand(np.random.SeedSequence(1), ring, _folder()) as stand:
        stand.cycles(260)
        stand.close_log("success", "")
        return stand.path.read_bytes()


def corpus(name: str) -> list[bytes]:
    """Good inputs of a target, from which the bad ones are made."""
    files = {
        "experiment": ["configs/experiments/default.yaml"],
        "arm": ["configs/lwr4plus.yaml"],
        "cell": ["configs/cell.yaml"],
        "emulator": ["configs/emulator/default.yaml"],
        "urdf": ["configs/lwr4plus.urdf"],
        "mapping": [f"configs/imports/{path.name}" for path in sorted((_ROOT / "configs/imports").iterdir())],
    }
    if name == "measurement":
        return [_packets(MSR_SIZE)]
    if name == "command":
        return [_packets(CMD_SIZE)]
    if name == "session_log":
        return [_log()]
    return [(_ROOT / path).read_bytes() for path in files[name] if (_ROOT / path).is_file()]
