"""Making and diagnosing many cases, each once."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from joblib import Parallel, delayed

from benchmarks.mujoco_arms.cases import ALL, draw, kind_of, make
from benchmarks.mujoco_arms.judging import diagnosis_of, judge, verdict_of
from benchmarks.mujoco_arms.tally import rho_of
from runner.file_names import DIAGNOSIS

_LONGEST_S = 3600.0


@dataclass(frozen=True)
class Plan:
    """What to run, see the command's help. reference : diagnose against the healthy days."""

    out: Path
    seed: int
    cases: int
    kind: str | None = None
    cause: str | None = None
    arm: str | None = None
    diagnose: bool = False
    again: bool = False
    twins: bool = False
    reference: bool = True

    def wanted(self) -> list[tuple[int, str]]:
        """Seed and kind of every case."""
        return [(seed, self._kind(seed)) for seed in range(self.seed, self.seed + self.cases)]

    def _kind(self, seed: int) -> str:
        if self.kind is not None:
            return self.kind
        if self.cause is None:
            return kind_of(seed)
        return "wear" if self.cause == "wear" else "single" if ALL[self.cause].listed else "outside"


def run(plan: Plan, jobs: int, say: Callable[[str], Any]) -> None:
    """Run all cases, printing a line for each."""
    work = Parallel(n_jobs=jobs, return_as="generator_unordered")
    for line in work(delayed(_one)(plan, seed, kind) for seed, kind in plan.wanted()):
        say(line)


def read_results(out: Path, reference: bool = True) -> list[dict[str, Any]]:
    """Verdicts on all diagnoses in a folder, or their crashes, in order of the cases' names."""
    found = sorted(out.glob(f"*/{verdict_of(out, reference).name}"))
    return [read_result(path.parent, reference) for path in found]


def read_result(folder: Path, reference: bool = True) -> dict[str, Any]:
    """The verdict on the diagnosis of a case, judged anew."""
    result = {**_json(verdict_of(folder, reference)), "truth": _json(folder / "truth.json")}
    if "crash" not in result:
        twin = diagnosis_of(folder / "twin", reference) / DIAGNOSIS
        told = _json(diagnosis_of(folder, reference) / DIAGNOSIS)
        result["verdict"] = judge(told, result["truth"], _json(twin) if twin.is_file() else None)
    return result


def _json(path: Path) -> dict[str, Any]:
    return dict(json.loads(path.read_text(encoding="utf-8")))


def _one(plan: Plan, seed: int, kind: str) -> str:
    began = time.monotonic()
    case = draw(seed, kind, plan.cause, plan.arm)
    folder = plan.out / case.name
    truth = make(case, folder)
    hidden = " + ".join(f"{h['cause']}({','.join(map(str, h['joints']))})" for h in truth["hidden"])
    line = f"{case.name:<14} rho {rho_of({'truth': truth}):5.2f}  {hidden or 'nothing':<40}"
    if not plan.diagnose:
        return f"{line} {time.monotonic() - began:.0f} s"
    verdict = verdict_of(folder, plan.reference)
    if not verdict.is_file() or plan.again:
        result: dict[str, Any] = {}
        try:
            result["seconds"] = diagnosed(folder, plan.again, reference=plan.reference)
            if truth["hidden"] and (kind == "outside" or plan.twins):
                diagnosed(folder / "twin", plan.again, folder, plan.reference)
        except (RuntimeError, subprocess.TimeoutExpired) as error:
            result["crash"] = str(error)
        verdict.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    result = read_result(folder, plan.reference)
    if "crash" in result:
        return f"{line} CRASH {result['crash'].splitlines()[-1]}"
    return f"{line} {'; '.join(result['verdict']['findings']) or 'silent'}"


def diagnosed(folder: Path, again: bool, home: Path | None = None, reference: bool = True) -> float:
    """Write the diagnosis of a folder's sessions; returns its processor time [s].

    home : folder of the reference days, where it is another. reference : False leaves those days out.
    RuntimeError with the last lines of a command that fails.
    """
    home = home or folder
    ratios = _json(home / "truth.json")["gear_ratio"]
    gear = ["--gear-ratio", ",".join(f"{ratio:g}" for ratio in ratios)]
    healthy = ["--reference", str(_commissioned(home, gear, again and home == folder))] if reference else []
    train = [str(path) for path in sorted(folder.glob("train_*.mcap"))]
    test = [item for path in sorted(folder.glob("test_*.mcap")) for item in ("--test", str(path))]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [
        "diagnose",
        *train,
        *test,
        *healthy,
        *gear,
        "--no-simulation",
        "--out",
        str(diagnosis_of(folder, reference)),
        "--force",
    ]
    _command(command, folder / "diagnose.txt")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _commissioned(home: Path, gear: Sequence[str], again: bool) -> Path:
    """The reference of the healthy days, made if it lacks."""
    path = home / "reference.yaml"
    if again:
        path.unlink(missing_ok=True)
    if not path.is_file():
        days = sorted(home.glob("reference_day_*"))
        logs = [str(log) for day in days for log in sorted(day.glob("*.mcap"))]
        command = ["commission", *logs, "--sets", str(len(days)), *gear, "--out", str(path)]
        _command(command, home / "commission.txt")
    return path


def _command(arguments: Sequence[str], log: Path) -> None:
    ended = subprocess.run(
        [sys.executable, "-m", "runner.cli", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=_LONGEST_S,
        check=False,
    )
    log.write_text(ended.stdout, encoding="utf-8")
    if ended.returncode:
        lines = ended.stdout.strip().splitlines()[-12:]
        raise RuntimeError("\n".join([f"{arguments[0]} ended with {ended.returncode}", *lines]))
