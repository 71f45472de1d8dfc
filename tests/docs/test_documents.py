"""Every command and every example of the documents is run; every link leads somewhere."""

from __future__ import annotations

import os
import re
import runpy
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import click
import pytest
import yaml
from click.testing import CliRunner

from fri.errors import LwrError
from ident.import_log import LogMapping
from runner.cli import VERBS, main
from runner.estimation import IdentifySettings
from runner.experiment_file import Experiment
from tests.docs.markdown import DOCUMENTS, ROOT, Command, blocks, commands

WITH_COMMANDS = [document for document in DOCUMENTS if any(not c.slow for c in commands(document))]
WITH_PYTHON = [d for d in DOCUMENTS if any(not block.slow for block in blocks(d, "python"))]
MADE = runpy.run_path(str(ROOT / "docs/site_pages.py"))["MADE"]
SLOW = [(document, command) for document in DOCUMENTS for command in commands(document) if command.slow]


def run(command: Command) -> None:
    where = f"line {command.line}: {command.text}"
    assert command.words[0] == "lwr-run", f"{where} is no command of this project"
    result = CliRunner().invoke(main, list(command.words[1:]))
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise AssertionError(where) from result.exception
    assert result.exit_code == command.code, f"{where} ended with {result.exit_code}\n{result.output}"
    if command.output is not None:
        Path(command.output).write_text(result.stdout)


def clear_outputs(document: Path) -> None:
    """Remove the files that the commands of a document write themselves."""
    for command in commands(document):
        if "--out" in command.words and not command.slow:
            Path(command.words[command.words.index("--out") + 1]).unlink(missing_ok=True)


@pytest.mark.slow
@pytest.mark.parametrize("document", WITH_COMMANDS, ids=str)
@pytest.mark.usefixtures("few_figures")
def test_commands_do_what_they_say(document: Path, workplace: Callable[[], Path]) -> None:
    place = workplace()
    if document.name == "quick_start.md":
        (place / "my_lab.yaml").write_text(blocks(document, "yaml")[0].text)
    elif document.name == "identify_settings.md":
        (place / "my_settings.yaml").write_text(blocks(document, "yaml")[0].text)
    elif document.name == "session_log.md":
        # A log that has no motor torques yet, and the controller's recording of the same motion.
        (place / "other" / "loaded.trace.csv").rename(place / "loaded.trace.csv")
        (place / "other" / "loaded.plain.mcap").replace(place / "loaded.mcap")
    clear_outputs(document)
    for command in commands(document):
        if not command.slow:
            run(command)


@pytest.mark.parametrize(("document", "command"), SLOW, ids=lambda value: str(getattr(value, "text", value)))
def test_slow_commands_exist_with_these_options(document: Path, command: Command) -> None:
    head, *rest = command.words
    if head == "make":
        assert re.search(rf"^{rest[0]}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
    elif head == "python":
        assert rest[0] == "-m"
        program = ROOT / rest[1].replace(".", "/")
        assert program.with_suffix(".py").is_file() or (program / "__main__.py").is_file()
    else:
        assert head == "lwr-run"
        with click.Context(main, **main.context_settings) as context:
            verb = main.get_command(context, rest[0])
            assert verb is not None
            verb.make_context(rest[0], rest[1:], parent=context, resilient_parsing=False)


@pytest.mark.long
@pytest.mark.parametrize("document", sorted({document for document, _ in SLOW}), ids=str)
def test_slow_commands_do_what_they_say(document: Path, workplace: Callable[[], Path]) -> None:
    place = workplace()
    if document.name == "quick_start.md":
        (place / "my_lab.yaml").write_text(blocks(document, "yaml")[0].text)
        shutil.rmtree(place / "results")
    elif document.name == "README.md":
        (place / "my_lab").mkdir()
        (place / "my_lab.yaml").rename(place / "my_lab/experiment.yaml")
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    for command in commands(document):
        words = list(command.words)
        # `make test` is what is running.
        if not command.slow or words == ["make", "test"]:
            continue
        if words[0] == "make":
            words = ["lwr-run", "experiment", "--yes"]
        elif words[0] == "python":
            words[0] = sys.executable
        elif words[1] == "experiment":
            words.append("--yes")
        done = subprocess.run(words, cwd=place, env=environment, capture_output=True, text=True)
        assert done.returncode == command.code, done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("document", WITH_PYTHON, ids=str)
def test_python_examples_work_one_after_the_other(document: Path, workplace: Callable[[], Path]) -> None:
    workplace()
    names: dict[str, object] = {}
    for block in blocks(document, "python"):
        if not block.slow:
            code = compile("\n" * (block.line - 1) + block.text, str(document), "exec")
            exec(code, names)


@pytest.mark.parametrize("document", DOCUMENTS, ids=str)
def test_yaml_files_in_documents_are_valid(document: Path, tmp_path: Path) -> None:
    path = tmp_path / "example.yaml"
    for block in blocks(document, "yaml"):
        if document.name == "identify_settings.md":
            path.write_text(block.text)
            IdentifySettings.load(path)
            continue
        if document.name == "import_mapping.md":
            path.write_text(block.text)
            LogMapping.load(path)
            continue
        content = {"name": "example", **yaml.safe_load(block.text)}
        path.write_text(yaml.safe_dump(content))
        Experiment.load(path)


@pytest.mark.parametrize("document", DOCUMENTS, ids=str)
def test_links_and_files_that_are_named_exist(document: Path) -> None:
    text = (ROOT / document).read_text()
    for target in re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", text):
        if "://" not in target and target not in MADE:
            assert ((ROOT / document).parent / target).exists(), f"{document}: {target}"
    for name in re.findall(
        r"`((?:configs|benchmarks|tests|fri|ident|runner|lwr_driver|sim_backend|docs)/[\w./]+)`", text
    ):
        assert (ROOT / name).exists(), f"{document}: {name}"


def test_every_option_that_a_document_names_exists() -> None:
    known = set()
    with click.Context(main, **main.context_settings) as context:
        for name in VERBS:
            command = main.get_command(context, name)
            assert command is not None
            for parameter in command.params:
                known.update((*parameter.opts, *parameter.secondary_opts))
    known.update(("--help", "--version", "-h", "-v", "-vv"))
    for program in (*(ROOT / "benchmarks").rglob("*.py"), ROOT / "runner/rerun_log.py"):
        known.update(re.findall(r'"(--[a-z][a-z-]*)"', program.read_text()))
    for document in DOCUMENTS:
        text = re.sub(r"^```.*?^```", "", (ROOT / document).read_text(), flags=re.MULTILINE | re.DOTALL)
        for option in re.findall(r"`(--[a-z][a-z-]*)", text):
            assert option in known, f"{document}: {option}"


def test_every_command_is_documented_in_order() -> None:
    rows = re.findall(r"^\| `([a-z]+)` \|", (ROOT / "docs/terminal.md").read_text(), re.MULTILINE)
    assert rows == list(VERBS)


def test_documented_exit_codes_are_those_of_the_errors() -> None:
    text = (ROOT / "docs/terminal.md").read_text()
    documented = {int(code) for code in re.findall(r"^\| (\d) \|", text, re.MULTILINE)}
    raised = {kind.exit_code for kind in (LwrError, *LwrError.__subclasses__())}
    assert documented == raised | {0}


def test_every_cause_is_documented_with_its_parameters() -> None:
    written = runpy.run_path(str(ROOT / "docs/effects_table.py"))
    assert written["PAGE"].read_text().endswith(written["tables"]()), "run python docs/effects_table.py"


def test_the_krl_program_is_explained_line_by_line() -> None:
    def lines(text: str) -> list[str]:
        return [s for line in text.splitlines() if (s := line.strip()) and s[0] not in "&;"]

    folder = ROOT / "configs/krl"
    data, *program = (block.text for block in blocks(Path("configs/krl/README.md"), "krl"))
    assert lines("\n".join(program)) == lines((folder / "lwr_identification.src").read_text())
    assert lines(data) == lines((folder / "lwr_identification.dat").read_text())
