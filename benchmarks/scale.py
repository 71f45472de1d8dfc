"""CPU time and peak memory of the commands by length and number of their sessions, at 1 kHz with two payloads.

Run `python -m benchmarks.scale LOGS [--minutes 1 10 30] [--sessions 20] [--commands identify validate ...]`. LOGS
is the folder of an experiment with the emulator; the periods of its `unloaded.mcap` and `loaded.mcap` are repeated to
the wanted length, with fresh noise of the sensors: two sessions of so many minutes, then so many sessions of half a
minute. `import` reads a CSV file of the first session. `--recorded` diagnoses the experiment's sessions as they are,
too. Peak memory is the kernel's figure for the command's process (`wait4`), the exponent that of the CPU time over the
samples, from the row before. All files stay in `--folder`.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pyarrow
from pyarrow.csv import write_csv

from lwr_driver.configuration import find
from lwr_driver.session import SessionWriter, read_session

POSITION_NOISE_RAD, TORQUE_NOISE_NM = 2e-6, 0.02
NAMES = ("unloaded", "loaded")
COMMANDS = ("identify", "validate", "report", "diagnose", "import")
SHORT_MIN = 0.5
MAPPING = f"""\
robot: emulated LWR4+
urdf: {find("lwr4plus.urdf")}
joints: [A1, A2, E1, A3, A4, A5, A6]
time: {{column: time}}
position: {{columns: [q1, q2, q3, q4, q5, q6, q7], unit: rad}}
joint_torque: {{columns: [tau1, tau2, tau3, tau4, tau5, tau6, tau7], unit: Nm}}
"""
_TILED = ("log_time", "publish_time", "sequence")


def tile(log: Path, path: Path, seconds: float, seed: int) -> None:
    """Write the periods of a session again and again, with fresh noise, one after the other."""
    source = read_session(log)
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


def elsewhere(work: Callable[..., object], *arguments: object) -> None:
    """Work in a process of its own: the peak memory of a command begins with that of the process that starts it."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        pool.submit(work, *arguments).result()


def as_csv(session: Path, path: Path) -> None:
    """The joint channel of a session as a text file: times and, of each joint, position and torque."""
    joint = read_session(session).joint
    quantities = {"q": joint.position, "tau": joint.effort}
    columns = {"time": (joint.log_time - joint.log_time[0]) * 1e-9}
    for name, values in quantities.items():
        columns |= {f"{name}{number + 1}": values[:, number] for number in range(values.shape[1])}
    write_csv(pyarrow.table(columns), path)


def command_of(name: str, folder: Path) -> list[str]:
    """Arguments of `lwr-run` for one command on the sessions of a folder."""
    logs = [str(path) for path in sorted(folder.glob("session-*.mcap"))]
    model = str(folder / "model.yaml")
    if name == "import":
        table = folder / "recording.csv"
        if not table.exists():
            elsewhere(as_csv, Path(logs[0]), table)
        (folder / "mapping.yaml").write_text(MAPPING)
        return ["import", str(folder / "mapping.yaml"), str(table), str(folder / "imported.mcap"), "--force"]
    return {
        "identify": ["identify", *logs, "--out", model, "--force"],
        "validate": ["validate", model, *logs, "--allow-seen"],
        "diagnose": ["diagnose", *logs, "--out", str(folder / f"diagnosis-{time.time_ns()}")],
        "report": ["identify", *logs, "--results", str(folder / f"results-{time.time_ns()}")],
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


def prepared(logs: Path, folder: Path, sessions: int, minutes: float) -> Path:
    """The folder with so many sessions of so many minutes, with and without payload in turn."""
    place = folder / f"{sessions}x{minutes:g}min"
    place.mkdir(parents=True, exist_ok=True)
    for number in range(sessions):
        path = place / f"session-{number:03d}.mcap"
        if not path.exists():
            elsewhere(tile, logs / f"{NAMES[number % 2]}.mcap", path, 60.0 * minutes, number)
    return place


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("logs", type=Path, help="folder of an experiment with the emulator")
    parser.add_argument("--minutes", type=float, nargs="*", default=[1.0, 10.0, 30.0])
    parser.add_argument("--sessions", type=int, nargs="*", default=[])
    parser.add_argument("--commands", nargs="+", default=list(COMMANDS), choices=COMMANDS)
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
    sets = [(2, minutes) for minutes in chosen.minutes] + [(number, SHORT_MIN) for number in chosen.sessions]
    for command in chosen.commands:
        before: tuple[float, float] | None = None
        for sessions, minutes in sets if command != "import" else [one for one in sets if one[0] == 2]:
            folder = prepared(chosen.logs, chosen.folder, sessions, minutes)
            words = command_of(command, folder)
            code, wall, cpu, peak = measure(words, folder / f"{command}.txt")
            size = sessions * minutes
            exponent = (
                "" if before is None else f"{math.log(cpu / before[1]) / math.log(size / before[0]):5.2f}"
            )
            print(
                f"{command:9} {sessions:4} x {minutes:4g} min: CPU {cpu:6.1f} s, wall {wall:6.1f} s, "
                f"peak {peak:6.0f} MB, exponent {exponent:>5}, exit {code}",
                flush=True,
            )
            before = size, cpu
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
