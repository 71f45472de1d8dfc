"""CPU time and peak memory of the commands by length of their sessions, at 1 kHz with two payloads.

Run `python -m benchmarks.scale LOGS [--minutes 1 10 60] [--commands identify validate ...]`. LOGS is the folder of an
experiment with the emulator; the periods of its `unloaded.mcap` and `loaded.mcap` are repeated to the wanted length,
with fresh noise of the sensors. `--recorded` diagnoses its sessions as they are, too. Peak memory is the kernel's
figure for the command's process (`wait4`).
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from lwr_driver.session import Session, SessionWriter, read_session

POSITION_NOISE_RAD, TORQUE_NOISE_NM = 2e-6, 0.02
NAMES = ("unloaded", "loaded")
_TILED = ("log_time", "publish_time", "sequence")


def tile(source: Session, path: Path, seconds: float, seed: int) -> None:
    """Write the periods of `source` again and again, with fresh noise, one after the other."""
    spans = source.spans("period")
    first, last = spans[0][0], spans[-1][1]
    length = last - first
    joint, motor, command = (
        None if c is None else c.rows(first, last) for c in (source.joint, source.motor, source.command)
    )
    assert joint is not None
    assert motor is not None
    assert command is not None
    random = np.random.default_rng(seed)
    step = int(np.median(np.diff(motor.log_time)))
    period = spans[0][1] - spans[0][0]
    urdf = source.robot_description
    metadata = dict(source.metadata) | {"uid": f"{source.metadata['uid']}-{seconds:.0f}"}
    with SessionWriter(path, source.joint_names, metadata, robot_description=urdf) as writer:
        for turn in range(round(seconds * 1e9 / length)):
            shift = turn * length
            for number in range(length // period):
                count = turn * (length // period) + number + 1
                writer.write_phase(first + shift + number * period, f"period {count}")
            times = joint.log_time + shift
            numbers = np.arange(len(times)) + turn * len(times)
            noise = random.normal(size=(2, *joint.position.shape))
            writer.write_joint_states(
                times,
                joint.position + POSITION_NOISE_RAD * noise[0],
                joint.effort + TORQUE_NOISE_NM * noise[1],
                sequence=numbers,
            )
            writer.write_joint_command(command.log_time + shift, command.position, sequence=numbers)
            at = np.arange(-(-(shift) // step), -(-(shift + length) // step)) * step
            effort = np.column_stack(
                [np.interp(at - shift, motor.log_time - first, column) for column in motor.effort.T]
            )
            writer.write_motor_states(first + at, effort + TORQUE_NOISE_NM * random.normal(size=effort.shape))
            if source.status is not None:
                inside = (source.status.log_time >= first) & (source.status.log_time < last)
                columns = {
                    name: values[inside]
                    for name, values in asdict(source.status).items()
                    if name not in _TILED
                }
                status = source.status.log_time[inside] + shift
                columns["sequence"] = numbers[: len(status)]
                writer.write_status(status, columns, sequence=numbers[: len(status)])
            writer.advance(first + shift + length - 10**9)


def command_of(name: str, folder: Path) -> list[str]:
    """Arguments of `lwr-run` for one command on the sessions of a folder."""
    logs = [str(folder / f"{session}.mcap") for session in NAMES]
    model = str(folder / "model.yaml")
    return {
        "identify": ["identify", *logs, "--out", model],
        "validate": ["validate", model, *logs, "--allow-seen"],
        "diagnose": ["diagnose", *logs, "--out", str(folder / f"diagnosis-{time.time_ns()}")],
        "results": ["identify", *logs, "--results", str(folder / f"results-{time.time_ns()}")],
    }[name]


def recorded(folder: Path, out: Path) -> list[str]:
    """Arguments of a diagnosis of an experiment's sessions as they are, its validation session held out."""
    logs = [str(folder / f"{session}.mcap") for session in NAMES]
    held = str(folder / "validation.mcap")
    return ["diagnose", *logs, "--test", held, "--out", str(out / f"diagnosis-{time.time_ns()}")]


def measure(arguments: Sequence[str], log: Path) -> tuple[int, float, float, float]:
    """Exit code, wall time [s], CPU time [s] and peak memory [MB] of a command in a process of its own."""
    start = time.monotonic()
    with log.open("w") as output:
        child = os.posix_spawn(
            sys.executable,
            [sys.executable, "-m", "runner.cli", *arguments],
            os.environ,
            file_actions=[
                (os.POSIX_SPAWN_DUP2, output.fileno(), 1),
                (os.POSIX_SPAWN_DUP2, output.fileno(), 2),
            ],
        )
        _, status, used = os.wait4(child, 0)
    cpu = used.ru_utime + used.ru_stime
    return os.waitstatus_to_exitcode(status), time.monotonic() - start, cpu, used.ru_maxrss / 1024


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("logs", type=Path, help="folder of an experiment with the emulator")
    parser.add_argument("--minutes", type=float, nargs="+", default=[1.0, 10.0, 60.0])
    parser.add_argument("--commands", nargs="+", default=["identify", "validate", "diagnose"])
    parser.add_argument("--folder", type=Path, default=Path("scale"), help="for the tiled sessions; kept")
    parser.add_argument(
        "--recorded", action="store_true", help="diagnose the experiment's own sessions first"
    )
    chosen = parser.parse_args(arguments)
    if chosen.recorded:
        chosen.folder.mkdir(parents=True, exist_ok=True)
        code, wall, cpu, peak = measure(recorded(chosen.logs, chosen.folder), chosen.folder / "recorded.txt")
        print(
            f"diagnose   as recorded: CPU {cpu:6.1f} s, wall {wall:6.1f} s, peak {peak:6.0f} MB, exit {code}"
        )
    for minutes in chosen.minutes:
        folder = chosen.folder / f"{minutes:g}min"
        folder.mkdir(parents=True, exist_ok=True)
        for seed, name in enumerate(NAMES):
            path = folder / f"{name}.mcap"
            if not path.exists():
                tile(read_session(chosen.logs / f"{name}.mcap"), path, 60.0 * minutes, seed)
        for command in chosen.commands:
            code, wall, cpu, peak = measure(command_of(command, folder), folder / f"{command}.txt")
            print(
                f"{command:10} 2 x {minutes:g} min: CPU {cpu:6.1f} s, wall {wall:6.1f} s, "
                f"peak {peak:6.0f} MB, exit {code}",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
