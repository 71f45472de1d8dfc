"""The command: sample, try, and tell what survived."""

from __future__ import annotations

import argparse
import ast
import json
import subprocess
import sys
from collections import Counter, defaultdict
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from benchmarks.mutation import exercise
from benchmarks.mutation.bugs import BUGS
from benchmarks.mutation.mutants import STRATA, Mutant, change, sample
from benchmarks.mutation.trial import Trials
from runner.computer import git_commit

ROOT = Path(__file__).resolve().parents[2]
REASONS = Path(__file__).with_name("survivors.yaml")
_CAUGHT = ("caught", "time")
# The first tests of a mutant take so long at most; most mutants need no more of them.
_FIRST_S = 4.0
# Sources that also run in processes unseen by coverage, and the tests that start these; their quick functions.
_APART, _QUICK_S = {"lwr_driver/loop.py": ("tests/lwr_driver/test_process.py",)}, 3.0
# A mutant may be slower than the code so many times, and longer by so much.
_SLOWER, _LONGER_S = 3.0, 10.0
# The tests of one beyond that run once more, so many times as long: a busy computer is slow, too.
_AGAIN = 4.0


def known_lines(trials: Trials, folder: Path) -> dict[str, exercise.FileOfTests]:
    """Lines and durations of all tests; measures what is new."""
    path = folder / "lines.json"
    known = exercise.load(path)
    while missing := exercise.stale(known, trials.tree)[:40]:
        print(f"measuring the lines of {len(missing)} files of tests", flush=True)
        command = [sys.executable, "-m", "benchmarks.mutation.exercise", str(path.resolve()), *missing]
        subprocess.run(command, cwd=trials.tree, env=trials.environment, check=True)
        known = exercise.load(path)
    present = {str(p.relative_to(trials.tree)) for p in (trials.tree / "tests").rglob("*.py")}
    return {file: entry for file, entry in known.items() if file in present}


class Tried:
    """Results of mutants by the content of their file: caught once is caught, a survivor meets new tests alone."""

    def __init__(self, path: Path, known: dict[str, exercise.FileOfTests]) -> None:
        self._path, self._known = path, known
        self._results: dict[str, dict[str, Any]] = (
            json.loads(path.read_text("utf-8")) if path.exists() else {}
        )

    def open(self, mutant: Mutant) -> dict[str, exercise.FileOfTests]:
        """The files of tests that a mutant has not met, none if it is caught."""
        found = self._results.get(self._key(mutant), {})
        if found.get("outcome") in _CAUGHT:
            return {}
        met = found.get("met", {})
        return {file: entry for file, entry in self._known.items() if met.get(file) != entry.digest}

    def get(self, mutant: Mutant) -> dict[str, Any] | None:
        """The result of an earlier trial, None without one."""
        return self._results.get(self._key(mutant))

    def put(self, mutant: Mutant, result: dict[str, Any], met: set[str]) -> None:
        """Keep a result after the tests of the files `met`."""
        before = self._results.get(self._key(mutant), {}).get("met", {})
        now = {file: self._known[file].digest for file in met}
        self._results[self._key(mutant)] = {**result, "met": {**before, **now}}
        self._path.write_text(json.dumps(self._results), encoding="utf-8")

    @staticmethod
    def _key(mutant: Mutant) -> str:
        return f"{mutant.file} {exercise.digest(ROOT / mutant.file)} {mutant.operator} {mutant.occurrence}"


def _compiled(source: str) -> list[ast.FunctionDef]:
    """The functions compiled by numba: coverage does not see their lines, and a binary of them may be stored."""
    return [
        node
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.FunctionDef)
        and any("njit" in ast.unparse(decorator) for decorator in node.decorator_list)
    ]


def _lines(source: str, mutant: Mutant) -> set[int]:
    """Lines whose tests may notice: those of the change, of the function with it in its head, or with the constant."""
    tree = ast.parse(source)
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    set_here = {
        node.id
        for statement in tree.body
        if isinstance(statement, ast.Assign | ast.AnnAssign)
        and statement.lineno <= mutant.line <= (statement.end_lineno or 0)
        for node in ast.walk(statement)
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
    }
    found = set(range(mutant.line, mutant.last + 1))
    for function in functions:
        used = {node.id for node in ast.walk(function) if isinstance(node, ast.Name)}
        if function.lineno <= mutant.line < function.body[0].lineno or used & set_here:
            found.update(range(function.body[0].lineno, (function.end_lineno or 0) + 1))
    return found


@cache
def _held_names(tree: Path) -> frozenset[str]:
    """All names in compiled functions: a binary holds the values of constants."""
    sources = [path.read_text("utf-8") for path in tree.rglob("*.py")]
    return frozenset(
        node.id
        for source in sources
        if "njit" in source
        for function in _compiled(source)
        for node in ast.walk(function)
        if isinstance(node, ast.Name)
    )


def _held_constant(source: str, line: int, tree: Path) -> bool:
    """Whether a line of a module sets a constant of compiled functions."""
    return any(
        isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id in _held_names(tree)
        for statement in ast.parse(source).body
        if isinstance(statement, ast.Assign | ast.AnnAssign)
        and statement.lineno <= line <= (statement.end_lineno or 0)
        for node in ast.walk(statement)
    )


def attempt(
    trials: Trials, mutant: Mutant, known: dict[str, exercise.FileOfTests], most_s: float
) -> tuple[dict[str, Any], set[str]]:
    """The fate of a mutant: its change, whether it was caught, by which test and in what time; the tests' files.

    known : files of tests it has not met. most_s : the longest tests are left out beyond so many seconds.
    """
    source = (trials.tree / mutant.file).read_text("utf-8")
    code = mutant.code(source)
    old, new = change(source, code)
    result = {"file": mutant.file, "line": mutant.line, "operator": mutant.operator, "old": old, "new": new}
    try:
        compile(code, mutant.file, "exec")
    except SyntaxError:
        return {**result, "outcome": "caught", "test": "the compiler", "seconds": 0.0}, set()
    jitted = any(node.lineno <= mutant.line <= (node.end_lineno or 0) for node in _compiled(source))
    lines = _lines(source, mutant)
    tests = exercise.tests_of(known, mutant.file, lines, anywhere=False)
    if jitted or not tests:
        tests = exercise.tests_of(known, mutant.file, lines, anywhere=True)
    tests = tests or exercise.tests_naming(known, mutant.file, trials.tree)
    for file in set(_APART.get(mutant.file, ())) & set(known) - {file for file, _, _ in tests}:
        quick = {name: took for name, took in known[file].seconds.items() if took < _QUICK_S}
        tests.append((file, list(quick), sum(quick.values())))
    near, mirror = f"tests/{Path(mutant.file).parent}/", f"test_{Path(mutant.file).stem}.py"
    useless = set(known) - {file for file, _, _ in tests}
    tests.sort(key=lambda item: (not item[0].endswith(mirror), not item[0].startswith(near), item[2]))
    while sum(item[2] for item in tests) > most_s and len(tests) > 1:
        tests.pop()
    tests.sort(key=lambda item: (not item[0].startswith(near), item[2]))
    met = useless | {file for file, _, _ in tests}
    stages: list[list[tuple[str, list[str], float]]] = [[]]
    for entry in tests:
        if stages[-1] and sum(item[2] for item in stages[-1]) + entry[2] > _FIRST_S * 4.0 ** (
            len(stages) - 1
        ):
            stages.append([])
        stages[-1].append(entry)
    seconds = 0.0
    with trials.replace(mutant.file, code):
        # Functions compiled before may hold a changed constant: such a survivor is tried without them too.
        constant = _held_constant(source, mutant.line, trials.tree)
        for fresh in (True,) if jitted else (False, True) if constant else (False,):
            for stage in stages if tests else ():
                files = [file for file, _, _ in stage]
                functions = {f"{file}::{function}" for file, names, _ in stage for function in names}
                limit = _LONGER_S * (6.0 if fresh else 1.0) + _SLOWER * sum(item[2] for item in stage)
                answer = trials.run(files, functions, limit, fresh=fresh)
                if answer["outcome"] == "time":
                    seconds += answer["seconds"]
                    answer = trials.run(files, functions, _AGAIN * limit, fresh=fresh)
                seconds += answer["seconds"]
                if answer["outcome"] != "survived":
                    return {**result, **answer, "seconds": seconds}, set()
    return {**result, "outcome": "survived" if tests else "not run", "test": "", "seconds": seconds}, met


def reason_of(result: dict[str, Any], reasons: list[dict[str, str]]) -> dict[str, str]:
    """The stored reason of a survivor, found by its file and its change."""
    for entry in reasons:
        if all(result[key] == entry[key] for key in ("file", "old", "new")):
            return entry
    return {}


def table(results: list[dict[str, Any]], reasons: list[dict[str, str]]) -> str:
    """Caught and survived by module, and the survivors."""
    lines = [f"{'module':<40} {'mutants':>8} {'caught':>8} {'survived':>8} {'caught':>8}"]

    def row(name: str, some: list[dict[str, Any]]) -> str:
        caught = sum(r["outcome"] in _CAUGHT for r in some)
        share = 100.0 * caught / max(len(some), 1)
        return f"{name:<40} {len(some):>8} {caught:>8} {len(some) - caught:>8} {share:>6.1f} %"

    for stratum, places in STRATA.items():
        mine = [r for r in results if r["file"].startswith(places)]
        if not mine:
            continue
        by_file = defaultdict(list)
        for r in mine:
            by_file[r["file"]].append(r)
        lines += [row(stratum, mine), *(row(f"  {file}", some) for file, some in sorted(by_file.items()))]
    lines.append(row("all", results))
    alive = [r for r in results if r["outcome"] not in _CAUGHT]
    kinds = Counter(reason_of(r, reasons).get("kind", "no reason yet") for r in alive)
    if alive:
        lines.append("survivors: " + ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items())))
    for r in alive:
        found = reason_of(r, reasons)
        why = f"{found['kind']}: {found['reason']}" if found else "no reason yet"
        note = " (no test runs it)" if r["outcome"] == "not run" else ""
        lines += [f"{r['file']}:{r['line']}{note}", f"  - {r['old']}", f"  + {r['new']}", f"    {why}"]
    return "\n".join(lines)


def store(folder: Path, results: list[dict[str, Any]], arguments: argparse.Namespace) -> str:
    """Write results.json and table.txt; returns the table."""
    reasons: list[dict[str, str]] = yaml.safe_load(REASONS.read_text("utf-8")) or []
    text = table(results, reasons)
    known = [{k: v for k, v in reason_of(r, reasons).items() if k in ("kind", "reason")} for r in results]
    content = {
        "commit": git_commit(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "sample": arguments.sample,
        "seed": arguments.seed,
        "only": arguments.only,
        "mutants": [{**r, **why} for r, why in zip(results, known, strict=True)],
    }
    (folder / "results.json").write_text(json.dumps(content, indent=1, ensure_ascii=False), encoding="utf-8")
    (folder / "table.txt").write_text(text + "\n", encoding="utf-8")
    return text


def replay(trials: Trials) -> int:
    """Try the bugs written by hand; returns the number that pass."""
    passed = 0
    for bug in BUGS:
        source = (trials.tree / bug.file).read_text("utf-8")
        if source.count(bug.old) != 1:
            print(f"{bug.file}: `{bug.old}` is there {source.count(bug.old)} times; mend the table")
            passed += 1
            continue
        files = list(dict.fromkeys(test.split("::")[0] for test in bug.tests))
        with trials.replace(bug.file, source.replace(bug.old, bug.new)):
            answer = trials.run(files, set(bug.tests), 300.0, fresh="njit" in source)
        caught = answer["outcome"] != "survived"
        passed += not caught
        print(
            f"{'caught' if caught else 'PASSED'} {answer['seconds']:6.1f} s  {bug.name}  {answer['test']}",
            flush=True,
        )
    print(f"{len(BUGS) - passed} of {len(BUGS)} bugs are caught")
    return passed


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.mutation", description=__doc__)
    parser.add_argument("--sample", type=int, default=400, help="number of mutants of all modules")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", default=[], help="draw from files that begin so")
    parser.add_argument("--package", nargs="+", choices=STRATA, help="of the sample, these packages alone")
    parser.add_argument(
        "--most", type=float, default=60.0, metavar="S", help="seconds of tests a mutant, the quickest first"
    )
    parser.add_argument("--anew", action="store_true", help="forget the results of earlier runs")
    parser.add_argument("--bugs", action="store_true", help="replay the bugs written by hand instead")
    parser.add_argument(
        "--control", action="store_true", help="run the tests as for a mutant, without a change"
    )
    parser.add_argument("--table", action="store_true", help="print the table of the last run")
    parser.add_argument(
        "--out",
        type=Path,
        default=ROOT / "build/mutation",
        help="folder of results, of the lines of the tests and of the copy",
    )
    arguments = parser.parse_args()
    folder: Path = arguments.out
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "results.json"
    before = json.loads(path.read_text("utf-8"))["mutants"] if path.exists() else []
    if arguments.table:
        print(store(folder, before, arguments))
        return 0
    with Trials(ROOT, folder.resolve()) as trials:
        if arguments.bugs:
            return min(replay(trials), 1)
        known = known_lines(trials, folder)
        if arguments.control:
            names = {f"{file}::{function}" for file, entry in known.items() for function in entry.seconds}
            answer = trials.run(sorted(known), names, 3600.0)
            print(f"without a change: {answer['test'] or 'no test'} fails, {answer['seconds']:.0f} s")
            return min(answer["outcome"] != "survived", 1)
        tried_path = folder / "tried.json"
        if arguments.anew:
            tried_path.unlink(missing_ok=True)
        tried = Tried(tried_path, known)
        places = tuple(place for name in arguments.package or STRATA for place in STRATA[name])
        drawn = [
            mutant
            for mutant in sample(ROOT, arguments.sample, arguments.seed, arguments.only)
            if mutant.file.startswith(places)
        ]
        reasons: list[dict[str, str]] = yaml.safe_load(REASONS.read_text("utf-8")) or []
        results = []
        for number, mutant in enumerate(drawn, start=1):
            result, open_ = tried.get(mutant), tried.open(mutant)
            # A survivor with a reason is not tried again.
            if result is None or (open_ and not reason_of(result, reasons)):
                earlier = result
                result, met = attempt(trials, mutant, open_, arguments.most)
                if earlier is not None and result["outcome"] == "not run":
                    result["outcome"] = earlier["outcome"]
                tried.put(mutant, result, met)
                print(
                    f"{number}/{len(drawn)} {result['outcome']:<8} {result['seconds']:5.1f} s "
                    f"{mutant.file}:{mutant.line}  {result['old'][:90]} -> {result['new'][:90]}",
                    flush=True,
                )
            results.append({key: value for key, value in result.items() if key != "met"})
            if number % 10 == 0:
                store(folder, results, arguments)
        print(store(folder, results, arguments))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
