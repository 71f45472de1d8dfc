"""The checks of a contributor: tests nearest to a change, hooks, subjects of commits."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]


def load(name: str) -> ModuleType:
    loader = SourceFileLoader(name, str(ROOT / ".ci" / name))
    spec = importlib.util.spec_from_loader(name, loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    return module


quick = load("quick")
subject = load("commit_subject")

FILES = {
    "fri/wire.py": "",
    "ident/__init__.py": "from ident.rows import build",
    "ident/rows/__init__.py": "from .build import rows",
    "ident/rows/build.py": "from fri.wire import *",
    "ident/plain.py": "",
    "runner/commands/info.py": "",
    "runner/cli.py": "f'runner.commands.{name}'",
    "tests/conftest.py": "",
    "tests/rows/samples.py": "from fri import wire",
    "tests/rows/test_rows.py": "import ident.rows.build",
    "tests/rows/test_samples.py": "from tests.rows.samples import one",
    "tests/use/conftest.py": "def cell(): return 'configs/cell.yaml'",
    "tests/use/test_face.py": "import ident",
    "tests/use/test_patch.py": "'runner.cli.main'",
    "tests/test_documents.py": "'docs/*.md'",
}


@pytest.fixture
def repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("BASE", raising=False)
    return tmp_path


@pytest.mark.parametrize(
    ("change", "near"),
    [
        ("ident/rows/build.py", {"tests/rows/test_rows.py": 1, "tests/use/test_face.py": 2}),
        (
            "fri/wire.py",
            {"tests/rows/test_rows.py": 2, "tests/rows/test_samples.py": 2, "tests/use/test_face.py": 3},
        ),
        ("ident/plain.py", {}),
        ("runner/commands/info.py", {"tests/use/test_patch.py": 2}),
        ("tests/rows/test_rows.py", {"tests/rows/test_rows.py": 0}),
        ("configs/cell.yaml", {"tests/use/test_face.py": 2, "tests/use/test_patch.py": 2}),
        ("docs/page.md", {"tests/test_documents.py": 1}),
        ("page.md", {}),
    ],
)
def test_distance_is_the_shortest_chain_of_imports(
    change: str, near: dict[str, int], repository: Path
) -> None:
    assert quick.distances(repository, {change}) == near


def test_a_test_of_a_deleted_module_is_found(repository: Path) -> None:
    (repository / "ident/rows/build.py").unlink()
    assert "tests/rows/test_rows.py" in quick.distances(repository, {"ident/rows/build.py"})


def test_a_conftest_belongs_to_every_test_below_it(repository: Path) -> None:
    tests = {name for name in FILES if Path(name).name.startswith("test_")}
    assert set(quick.distances(repository, {"tests/conftest.py"})) == tests


def test_the_nearest_are_chosen_then_the_likest_then_the_cheapest() -> None:
    near = {"tests/a/test_far.py": 3, "tests/b/test_dear.py": 1, "tests/b/test_cheap.py": 1}
    near |= {"tests/rows/test_rows.py": 1, "tests/b/test_huge.py": 1}
    cost = {"tests/a/test_far.py": 9.0, "tests/b/test_dear.py": 7.0, "tests/b/test_huge.py": 50.0}
    cost |= {"tests/b/test_cheap.py": 1.0, "tests/rows/test_rows.py": 8.0}
    run, left = quick.choose(near, {"ident/rows/build.py"}, cost, 25.0)
    assert run == [
        "tests/rows/test_rows.py",
        "tests/b/test_cheap.py",
        "tests/b/test_dear.py",
        "tests/a/test_far.py",
    ]
    assert left == ["tests/b/test_huge.py"]


def git(*words: str) -> str:
    settings = ["-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "init.defaultBranch=main"]
    return subprocess.run(
        ["git", *settings, *words], check=True, capture_output=True, text=True
    ).stdout.strip()


def test_changes_are_counted_from_the_fork_or_from_the_last_commit(
    repository: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in os.environ if name.startswith("GIT_")]:
        monkeypatch.delenv(name)
    git("init")
    git("add", ".")
    git("commit", "-m", "First")
    (repository / "ident/plain.py").write_text("a = 1\n")
    git("commit", "-a", "-m", "Second")
    assert quick.changed() == {"ident/plain.py"}
    (repository / "ident/new.py").touch()
    assert quick.changed() == {"ident/new.py"}
    git("checkout", "-b", "work")
    git("rm", "fri/wire.py")
    git("commit", "-m", "Third")
    assert quick.changed() == {"ident/new.py", "fri/wire.py"}
    monkeypatch.setenv("BASE", "main~1")
    assert quick.changed() == {"ident/new.py", "fri/wire.py", "ident/plain.py"}


def test_the_rest_is_skipped_and_named_once_the_time_is_spent(tmp_path: Path) -> None:
    (tmp_path / "test_some.py").write_text("def test_a(): pass\ndef test_b(): assert False\n")
    program = (
        f"import runpy, pytest; b = runpy.run_path({str(ROOT / '.ci/quick')!r})['Budget'](0.0); "
        "code = pytest.main(['-p', 'no:cacheprovider', 'test_some.py'], plugins=[b]); print(int(code), b.cut)"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == "0 {'test_some.py': 2}", done.stdout + done.stderr


@pytest.mark.parametrize(
    "good",
    [
        "Add a licence",
        "Press on after a lost packet",
        "Seed the planner",
        'Revert "Added."',
        "Merge branch 'docs'",
    ],
)
def test_an_imperative_subject_passes(good: str) -> None:
    assert subject.faults(good) == []


@pytest.mark.parametrize(
    ("bad", "fault"),
    [
        ("Added a licence", "-ed"),
        ("Adds a licence", "-s"),
        ("Adding a licence", "-ing"),
        ("add a licence", "capital"),
        ("Add a licence.", "full stop"),
        ("Add " + 69 * "a", "73 characters, at most 72"),
        ("", "capital"),
    ],
)
def test_a_fault_of_a_subject_is_named(bad: str, fault: str) -> None:
    assert fault in " ".join(subject.faults(bad))


def test_the_hook_reads_the_file_that_git_hands_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    message = tmp_path / "COMMIT_EDITMSG"
    message.write_text("# a comment\n\nAdd a licence\n\nAnd so on.\n")
    assert subject.main(str(message)) == 0
    message.write_text("Added.\n")
    assert subject.main(str(message)) == 1
    assert "commit subject 'Added.': ends with a full stop" in capsys.readouterr().err


def test_hooks_run_tools_of_the_project_only() -> None:
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())
    assert [repository["repo"] for repository in hooks["repos"]] == ["local"]
    entries = {hook["id"]: hook["entry"].split() for hook in hooks["repos"][0]["hooks"]}
    assert set(entries) == {"ruff-check", "ruff-format", "mypy", "commit-subject"}
    for program, *arguments in entries.values():
        assert program.startswith(".venv/bin/")
        assert all((ROOT / word).is_file() for word in arguments if word.startswith(".ci/"))


def test_processes_share_the_tests_evenly_and_numerics_are_checked_soonest() -> None:
    cost = {"a": 6.0, "b": 5.0, "c": 2.0, "d": 1.0}
    assert quick.shares(["d", "c", "b", "a"], cost) == [["d", "a"], ["c", "b"]]
    assert quick.shares(["a"], cost) == [["a"]]
    assert quick.limit_s({"ident/rows/build.py", "tests/fri/test_wire.py"}) == quick.NEAR_S
    assert quick.limit_s({"ident/rows/build.py", "runner/cli.py"}) == quick.FAR_S
