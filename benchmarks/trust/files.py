"""Crafted files, each with one thing wrong: `lwr-run check` or `plan` ends with an error and advice, in seconds.

Units mistaken (deg, mm, g, percent), numbers out of any range, huge planning jobs, limits wider than the arm's, bodies
that cannot be, shapes without size, texts without end, broken YAML, references that lead nowhere or back.
"""

from __future__ import annotations

import copy
import importlib
import multiprocessing
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from benchmarks.trust.table import Ledger, stamp

__all__ = ["CASES", "campaign", "judge"]

_CONFIGS = Path(__file__).resolve().parents[2] / "configs"
_PATIENCE_S = 120.0
_NAN, _INF, _HUGE = float("nan"), float("inf"), 1e300
_LOADED = {"name": "loaded", "payload": {"name": "load", "mass": 3.34, "com": [0.0, -0.066, 0.144]}}
_BASE: dict[str, dict[str, Any]] = {
    "experiment": {"name": "crafted", "sessions": [{"name": "unloaded"}, _LOADED]},
    "arm": yaml.safe_load((_CONFIGS / "lwr4plus.yaml").read_text()),
    "cell": {
        "schema_version": 1,
        "name": "lab",
        "boxes": [{"name": "table", "size_m": [0.8, 1.2, 0.05], "centre_m": [0.9, 0.0, -0.3]}],
    },
    "emulator": {"base": "emulator/default.yaml"},
    "plan": yaml.safe_load((_CONFIGS / "plans/default.plan.yaml").read_text()),
    "problem": {
        **yaml.safe_load((_CONFIGS / "plans/default.yaml").read_text()),
        "search": {"starts": 1, "hops": 0, "lanes": 1},
    },
}
_LOAD = "sessions.1.payload"
_SHAPE = {"shape": "sphere", "size_m": [0.1], "centre_m": [0.0, 0.0, 0.1]}

#: By kind of file: (dotted key, wrong values).
_WRONG: dict[str, list[tuple[str, list[Any]]]] = {
    "experiment": [
        ("name", ["", "../up", "a" * 300, 7, None]),
        (f"{_LOAD}.mass", [3340, -1, 0, _NAN, _INF, 10**400, "heavy"]),
        (
            f"{_LOAD}.com",
            [[0, -66, 144], [0, -6.6, 14.4], [0.4, 0.4, 0.4], [_NAN, 0, 0], [0, 0], [1e9, 0, 0]],
        ),
        (
            f"{_LOAD}.inertia",
            [
                [-0.01, 0, 0, 0.01, 0, 0.01],
                [0.01, 0, 0, 0.01, 0, 0.1],
                [0.01, 0.02, 0, 0.01, 0, 0.01],
                [89, 0, 0, 71, 0, 21],
                [0.01, 0, 0, 0, 0, 0],
                [2.0, 0, 0, 2.0, 0, 2.0],
            ],
        ),
        (f"{_LOAD}.name", ["none", "a/b", "", "x" * 5000, "a\x00b"]),
        (
            f"{_LOAD}.shape",
            [
                {**_SHAPE, "size_m": [0.0]},
                {**_SHAPE, "size_m": [-0.1]},
                {**_SHAPE, "size_m": [100]},
                {**_SHAPE, "size_m": [0.1, 0.2]},
                {**_SHAPE, "centre_m": [0, 0, 144]},
                {**_SHAPE, "shape": "mesh"},
            ],
        ),
        ("sessions.0.name", ["s" * 300, "..", "loaded", 3]),
        ("sessions", [[], [{"name": f"s{k}"} for k in range(200)], "all"]),
        (
            "moves.home",
            [[0, 28, 0, -74, 0, 45, 0], [0, 0.5, 0], [_NAN] * 7, [4.0] * 7, [0, 2.5, 0, 0, 0, 0, 0]],
        ),
        ("moves.settle_s", [1e6, 0, -1, _INF]),
        ("moves.brake_s", [1e6, -5, _HUGE]),
        ("moves.speed_scale", [20, 0, -0.2, 1.5, 1e-300]),
        ("moves.clearance_m", [-1, 30, _HUGE]),
        ("moves.max_start_distance_rad", [-1, 170]),
        ("excitation.period_s", [1e5, 1e300, 0, -20, _NAN, 1e-9]),
        ("excitation.harmonics", [10**6, 1, 0, -3, 2.5]),
        ("excitation.periods", [10**5, 0, -1, 10**12]),
        ("excitation.seed", [-1, 2**70, 1.5]),
        ("excitation.speed_scale", [50, 0, -1]),
        ("excitation.plan", ["nowhere.yaml", "a" * 5000, "/etc/passwd", 7]),
        ("link.port", [70000, -1]),
        ("link.quality_s", [1e9, -1, _HUGE]),
        ("link.handshake", ["piano"]),
        ("identification.cutoff_hz", [-8, 0, 1e9]),
        ("diagnosis.sure", [80, 0.1]),
        ("replan.rounds", [-1, 10**6]),
        ("arm", ["nowhere.yaml", "../" * 400 + "x", {"a": 1}]),
        (
            "emulator_settings",
            [{"fri.period_ms": 0}, {"robot.payload": "piano"}, {"nonsense": 1}, {"seed": -1}],
        ),
        ("motor_torque.krl.reals", [[0, 1, 2, 3, 4, 5, 6], [1] * 7]),
    ],
    "arm": [
        ("joints.0.velocity_deg_s", [1.92, 187, 0, -1, _NAN, _HUGE]),
        ("joints.2.acceleration_rad_s2", [458, 60, 16, 0, _INF]),
        ("joints.4.jerk_rad_s3", [5730, 36200, 0, -5]),
        ("joints.1.position_deg", [[-2.09, 2.09], [-175, 175], [120, -120], [_NAN, 1]]),
        ("joints.6.torque_nm", [176, 0, -38]),
        ("joints.3.gear_ratio", [0, 1e9]),
        ("joints.3.stiffness_nm_rad", [-1, 1e300]),
        ("position_margin_deg", [-1, 90]),
        ("lowest_resonance_hz", [0, -6, _INF]),
        ("urdf", ["nowhere.urdf", "arm.yaml", "a" * 3000]),
        ("schema_version", [2]),
    ],
    "cell": [
        ("boxes.0.size_m", [[800, 1200, 50], [0, 1, 1], [-0.8, 1, 1], [1e300, 1, 1], [_NAN, 1, 1]]),
        ("boxes.0.centre_m", [[900, 0, 300], [_INF, 0, 0]]),
        ("boxes.0.rpy_deg", [[1e9, 0, 0]]),
        ("boxes.0.name", ["b" * 3000]),
        ("margin_m", [20, -0.1, _NAN]),
        ("ground_z_m", [500, _HUGE]),
        ("schema_version", ["one"]),
    ],
    "emulator": [
        ("seed", [-1, 2**80]),
        ("robot.stiffness", [[0] * 7, [-1] * 7, [1e300] * 7, [15000] * 6]),
        ("robot.start_position", [[0, 28, 0, -74, 0, 45, 0], [_NAN] * 7]),
        ("robot.substeps", [0, 10**9]),
        ("robot.parameters", ["nowhere.yaml"]),
        ("robot.effects", [[{"type": "nowhere"}], [{"type": "os.path:join"}], [{"type": "nowhere.at:All"}]]),
        ("robot.plant", [{"type": "pathlib:Path"}]),
        ("controller.settle_s", [1e6, -1]),
        ("controller.load", [{"mass": -1}, {"mass": 3340}, {"mass": 1, "com": [0, 0, 100]}]),
        ("controller.model_period_ms", [0, 10**9]),
        ("sensors.joint_torque_noise", [[-1, 0, 0, 0, 0, 0, 0], [_INF] * 7]),
        ("sensors.temperature", [1e30]),
        ("krl_reals.tick_ms", [0, 10**9]),
        ("trace.longest_s", [1e12, 0]),
        ("fri.period_ms", [1000, 0]),
        ("fri.velocity", [[110] * 7, [0] * 7]),
        ("policy.window", [0, 10**12]),
        (
            "faults",
            [[{"kind": "fire"}], [{"kind": "loss", "probability": 5}], [{"kind": "delay", "length": 10**12}]],
        ),
        ("schedule", [[{"command": "dance"}], [{"command": "emergency_stop", "after_cycles": -1}]]),
        ("base", ["emulator.yaml", 7]),
    ],
    "plan": [
        ("joint_names", [["A6", "A5", "A4", "A3", "E1", "A2", "A1"], ["A1"], []]),
        ("motion.period_s", [1e5, 0, _NAN]),
        ("motion.bias", [[0, 28, 0, -74, 0, 45, 0], [_INF] * 7, "all"]),
        ("motion.a", [[[1e300] * 5] * 7, [[0.0] * 5] * 6, [[0.1, 0.2]] + [[0.1]] * 6]),
        ("motion.type", ["jump", None]),
        ("motion", [[], None]),
        ("periods", [10**6, 0, "two"]),
        ("kind", ["poem"]),
    ],
    "problem": [
        ("motion.period_s", [1e5, -1]),
        ("motion.harmonics", [10**6]),
        ("motion.periods", [10**6]),
        ("search.starts", [10**9, 0]),
        ("search.hops", [10**12]),
        ("search.time_limit_s", [-1]),
        ("knowledge.file", ["nowhere.yaml"]),
        ("clearance_m", [20]),
        ("sessions", [[]]),
    ],
}
_RAW = (
    b"a: &a [1]\nname: [*a, *a\n", b"&x [*x]\n", b"\xff\xfe\x00", b"- " * 5000, b"[" * 5000, b"",
    b"name: !!python/object/apply:os.system ['true']\n", b"name: &a [x]\nsessions: &b [*a, *a]\n? [1]\n: 2\n",
    b"".join(b"l%d: &l%d [%s]\n" % (k, k, b", ".join([b"*l%d" % (k - 1)] * 9) if k else b"1") for k in range(30)),
)  # fmt: skip


def _cases() -> Iterator[tuple[str, str, Any]]:
    for kind, entries in _WRONG.items():
        for key, values in entries:
            for value in values:
                yield kind, key, value
    for number, text in enumerate(_RAW):
        yield "experiment", f"text {number}", text


UNCHANGED = tuple((kind, "", None) for kind in _BASE)
CASES: tuple[tuple[str, str, Any], ...] = tuple(_cases())


def _changed(content: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    changed = copy.deepcopy(content)
    place: Any = changed
    *path, last = key.split(".")
    for name in path:
        place = place[int(name)] if isinstance(place, list) else place.setdefault(name, {})
    place[last] = value
    return changed


def _written(folder: Path, kind: str, key: str, value: Any) -> list[str]:
    """The files of a case; the arguments of its command."""
    files = {name: copy.deepcopy(content) for name, content in _BASE.items()}
    (folder / "lwr4plus.urdf").write_bytes((_CONFIGS / "lwr4plus.urdf").read_bytes())
    experiment = files["experiment"]
    experiment |= {name: f"{name}.yaml" for name in ("arm", "cell", "emulator")}
    if kind == "plan":
        experiment["excitation"] = {"plan": "plan.yaml"}
    else:
        experiment["excitation"] = {"period_s": 6.0, "harmonics": 3, "periods": 1}
    if key and not isinstance(value, bytes):
        files[kind] = _changed(files[kind], key, value)
    for name, content in files.items():
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(content))
    if isinstance(value, bytes):
        (folder / "experiment.yaml").write_bytes(value)
    if kind == "problem":
        return ["plan", str(folder / "problem.yaml"), "--out", str(folder / "made.yaml")]
    return ["check", str(folder / "experiment.yaml")]


def _command(arguments: list[str], out: Path) -> None:
    os.setsid()
    stream = os.open(out, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(stream, 1)
    os.dup2(stream, 2)
    from runner.cli import main

    # A test runner has put its own streams in place.
    with open(1, "w", closefd=False) as sys.stdout, open(2, "w", closefd=False) as sys.stderr:
        main(arguments)


def _words(key: str, value: Any) -> list[str]:
    """What an error may name: the key, the value, or a key or value within it."""
    inner = value if isinstance(value, dict) else value[0] if isinstance(value, list) and value else {}
    parts = [str(word) for pair in inner.items() for word in pair] if isinstance(inner, dict) else []
    own = [part for part in key.split(".") if not part.isdigit()][-1]
    return [own, str(value)[:12], *(part.split(".")[-1] for part in parts)]


def judge(kind: str, key: str, value: Any) -> tuple[list[str], float]:
    """What did not hold of a case, and its time [s]. Without a key the files are right and have to pass."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        arguments = _written(folder, kind, key, value)
        out = folder / "output.txt"
        process = multiprocessing.get_context("fork").Process(target=_command, args=(arguments, out))
        began = time.monotonic()
        process.start()
        process.join(_PATIENCE_S)
        took = time.monotonic() - began
        if process.is_alive():
            assert process.pid is not None
            os.killpg(process.pid, signal.SIGKILL)
            process.join()
            return [f"not ended after {_PATIENCE_S:.0f} s"], took
        text = out.read_text(errors="replace")
    if not key:
        return [] if process.exitcode == 0 else [f"exit code {process.exitcode}: {text[-300:]}"], took
    bad = []
    if process.exitcode not in (2, 3):
        bad.append(f"exit code {process.exitcode}: {text[-300:]}")
    if "Traceback" in text:
        bad.append(f"traceback: {text[-300:]}")
    said = text.partition("Error: ")[2]
    if not isinstance(value, bytes) and not any(word in said for word in _words(key, value)):
        bad.append(f"the error names neither key nor value: {said[:300]!r}")
    if not said:
        bad.append("no error of ours")
    if len(said) > 4000:
        bad.append(f"a message of {len(text)} characters")
    return bad, took


def campaign(ledger: Ledger, options: Any) -> None:
    """A line for each kind of file."""
    for module in ("runner.commands.motions", "runner.files", "sim_backend.rehearsal"):
        importlib.import_module(module)  # before the forks

    for number, (kind, key, value) in enumerate((*UNCHANGED, *CASES)):
        if options.only is not None and number != options.only:
            continue
        if ledger.has("files", str(number)):
            continue
        bad, took = judge(kind, key, value)
        line = ledger.line("files", kind if key else "unchanged")
        line.figures |= stamp()
        line.count(bad, f"case {number}, {key} = {value!r:.60}")
        if bad:
            options.say(f"case {number}, {kind}, {key} = {value!r:.60}: {bad}")
        line.figures["slowest [s]"] = max(line.figures.get("slowest [s]", 0.0), round(took, 1))
        ledger.finish("files", str(number))
