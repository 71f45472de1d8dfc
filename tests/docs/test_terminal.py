"""The command line as a whole: options, JSON, colours, exit codes, completion."""

from __future__ import annotations

import dataclasses
import json
import os
import pty
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import pytest
import yaml
from click.testing import CliRunner

from fri.errors import (
    ConfigurationError,
    DataError,
    LwrError,
    NetworkError,
    OperatorError,
    RefusedError,
    RobotError,
)
from ident.estimators import ESTIMATORS
from ident.excitation import ExcitationPlan
from ident.model.model_file import read_model
from lwr_driver.configuration import find
from runner.cli import VERBS, main
from runner.estimation import IdentifySettings
from runner.laboratory import free_port
from runner.terminal import to_json

LWR_RUN = str(Path(sys.executable).parent / "lwr-run")


def run(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(main, list(arguments))
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout if result.exit_code == 0 else result.output


def verb(name: str) -> click.Command:
    with click.Context(main, **main.context_settings) as context:
        command = main.get_command(context, name)
    assert command is not None
    return command


SESSIONS = ("unloaded.mcap", "loaded.mcap", "--model", "1")
SETTINGS = ("--settings", "settings.yaml")


def write_settings(place: Path, **content: Any) -> None:
    (place / "settings.yaml").write_text(yaml.safe_dump(content))


# One call of each, in the folder that the documents speak of; what it must say, as a path into the JSON.
REPORTS: dict[str, tuple[str, str]] = {
    "init": ("init my_laboratory", "files.0"),
    "doctor": ("doctor", "findings.0.advice"),
    "record": ("record my_lab.yaml --seconds 1 --out recorded.mcap", "log"),
    "hold": ("hold my_lab.yaml --seconds 1 --out held.mcap", "log"),
    "jog": ("jog A6 -2 my_lab.yaml --out jogged.mcap", "after.6"),
    "home": ("home my_lab.yaml --out homed.mcap", "done"),
    "experiment": ("experiment --resume results --yes --no-diagnosis", "sessions.0.exit_status"),
    "plan": ("plan --out my.plan.yaml", "margins.0.limit"),
    "check": ("check my_lab.yaml", "loaded.0.limit"),
    "preview": ("preview my_lab.yaml --out preview.html", "tightest.distance_m"),
    "replay": (
        "replay loaded.mcap --model model.yaml --longest-s 3 --length-s 1 --out loaded.gif",
        "rms.base.torque_nm.0",
    ),
    "report": ("report results", "verdicts.0.level"),
    "identify": ("identify unloaded.mcap --model 1", "parameters.0.estimate"),
    "validate": ("validate model.yaml another.mcap", "sessions.0.scores.0.rms"),
    "commission": ("commission unloaded.mcap loaded.mcap --out commissioned.yaml", "file"),
    "diagnose": ("diagnose unloaded.mcap loaded.mcap --no-simulation --out diagnosis", "findings"),
    "compare": ("compare model.yaml another_model.yaml", "level"),
    "payload": ("payload model.yaml loaded.mcap", "payload"),
    "export": ("export model.yaml out.urdf", "files.0.format"),
    "info": ("info loaded.mcap", "metadata.robot"),
    "recover": ("recover broken.mcap", "needed"),
    "attach": ("attach bare.mcap other/loaded.trace.csv --force", "alignment.delay_s"),
    "import": ("import mapping.yaml recording imported.mcap", "rows_in_source"),
    "schema": ("schema cell", "properties.margin_m"),
    "example": ("example --list", "0.name"),
}
SLOW_REPORTS = ("commission", "diagnose")
SLOW_ON_SCREEN = (*SLOW_REPORTS, "experiment", "record", "hold", "jog", "home", "preview")
MAPPING = {
    "robot": "bench arm",
    "joints": ["a"],
    "time": {"column": "t", "file": "arm.csv"},
    "position": {"file": "arm.csv", "columns": ["q"], "unit": "rad"},
    "joint_torque": {"file": "arm.csv", "columns": ["tau"], "unit": "Nm"},
}


def prepare(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files for `REPORTS`, and the stored plan in place of a search."""
    (place / "other" / "loaded.plain.mcap").rename(place / "bare.mcap")
    (place / "recording").mkdir()
    (place / "recording" / "arm.csv").write_text("t,q,tau\n0,0,1\n0.01,0.1,1.1\n0.02,0.2,1\n")
    (place / "mapping.yaml").write_text(yaml.safe_dump(MAPPING))
    stored = ExcitationPlan.load(find("plans/default.plan.yaml"))
    monkeypatch.setattr("ident.excitation.planner.plan", lambda problem, report: stored)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.long) if n in SLOW_REPORTS else n for n in REPORTS]
)
def test_commands_that_report_print_one_json_value(
    name: str, workplace: Callable[[], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    prepare(workplace(), monkeypatch)
    line, wanted = REPORTS[name]
    code, text = run(*line.split(), "--json")
    assert code == 0, text
    value = json.loads(text, parse_constant=lambda constant: pytest.fail(f"{constant} is no JSON"))
    for part in wanted.split("."):
        value = value[int(part)] if isinstance(value, list) else value[part]


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.long) if n in SLOW_ON_SCREEN else n for n in REPORTS]
)
def test_no_line_of_a_command_is_longer_than_a_narrow_screen(
    name: str, workplace: Callable[[], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    prepare(workplace(), monkeypatch)
    monkeypatch.setattr("runner.status.watched", lambda stream: True)
    monkeypatch.setenv("COLUMNS", "40")
    done = CliRunner().invoke(main, [*REPORTS[name][0].split(), "--verbose"])
    assert done.exit_code == 0, done.output
    lines = done.stdout.splitlines()
    assert lines
    if name != "schema":  # a file for programs
        assert max(map(len, lines)) <= 40, max(lines, key=len)


def test_every_command_reports_here_or_in_tests_of_its_own() -> None:
    assert set(VERBS) - set(REPORTS) == {"emulator", "completion", "batch", "trend"}


def test_the_emulator_tells_its_ports_as_json() -> None:
    port, pendant = free_port("127.0.0.1"), free_port("127.0.0.1")
    command = [LWR_RUN, "emulator", "--json", "--lock-step", "--period-ms", "4"]
    command += ["--fri-host", "127.0.0.1", "--fri-port", str(port), "--pendant-port", str(pendant)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            text = process.stdout.readline()
            while not text.rstrip().endswith("}"):
                text += process.stdout.readline()
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 0
        finally:
            process.kill()
    said = json.loads(text)
    assert (said["fri_host"], said["fri_port"]) == ("127.0.0.1", port)
    assert said["pendant_port"] == pendant


@pytest.mark.parametrize("name", VERBS)
def test_the_help_of_every_command_has_an_example_that_it_understands(name: str) -> None:
    command = verb(name)
    result = CliRunner().invoke(main, [name, "-h"])
    assert result.exit_code == 0, (result.output, result.exception)
    examples = [
        line.strip() for line in str(command.help).splitlines() if line.strip().startswith("lwr-run ")
    ]
    assert examples
    for example in examples:
        call = re.split(r"\s{2,}", example)[0]
        assert call in result.output
        with click.Context(main, **main.context_settings) as context:
            _, words, _ = main.make_parser(context).parse_args(shlex.split(call.partition(" >")[0])[1:])
            assert words[0] == name
            command.make_context(name, words[1:], parent=context)


# The same thing has the same name in every command.
MEANINGS = {
    "--out": "path",
    "--json": "boolean",
    "--yes": "boolean",
    "--force": "boolean",
    "--arm": "path",
    "--urdf": "path",
    "--port": "integer range",
    "--period-ms": "float range",
    "--allow-non-realtime": "boolean",
}


def test_options_of_one_name_are_of_one_kind_and_of_one_style() -> None:
    for name in VERBS:
        for parameter in verb(name).params:
            if not isinstance(parameter, click.Option):
                continue
            for option in (*parameter.opts, *parameter.secondary_opts):
                assert option in ("-h", "-v") or (option.startswith("--") and option == option.lower()), (
                    option
                )
                assert "_" not in option, f"{name} {option}"
                if option in MEANINGS:
                    assert parameter.type.name == MEANINGS[option], f"{name} {option}"


@pytest.mark.parametrize("name", VERBS)
def test_arguments_stand_in_the_usage_alone(name: str) -> None:
    command = verb(name)
    page = command.get_help(click.Context(command, info_name=name))
    entries = {line.strip() for line in page.splitlines()}
    usages = {
        one.make_metavar(click.Context(command)) for one in command.params if isinstance(one, click.Argument)
    }
    assert not entries & usages


@pytest.mark.parametrize("name", VERBS)
def test_every_option_has_a_help_text_and_a_sentence_of_its_own(name: str) -> None:
    command = verb(name)
    assert command.help
    for parameter in command.params:
        if isinstance(parameter, click.Option) and parameter.opts[0] not in ("--estimator",):
            assert parameter.help, f"{name} {parameter.opts[0]}"
            assert parameter.help.rstrip()[-1] in ".;", f"{name} {parameter.opts[0]}"


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (LwrError, 1),
        (ConfigurationError, 2),
        (RefusedError, 3),
        (OperatorError, 4),
        (RobotError, 5),
        (NetworkError, 6),
        (DataError, 7),
    ],
)
def test_exit_code_says_who_must_act(
    error: type[LwrError], code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: Any, **named: Any) -> None:
        raise error("A4 is 3 rad, limit 2 rad; move it")

    monkeypatch.setattr(verb("completion"), "callback", fail)
    result = CliRunner().invoke(main, ["completion", "bash"])
    assert result.exit_code == code
    assert result.output.strip() == f"{error.__name__}: A4 is 3 rad, limit 2 rad; move it"
    assert result.stdout == ""


@pytest.mark.parametrize("error", [KeyboardInterrupt, click.Abort])
def test_ctrl_c_is_the_operators(error: type[BaseException], monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: Any, **named: Any) -> None:
        raise error

    monkeypatch.setattr(verb("completion"), "callback", fail)
    assert CliRunner().invoke(main, ["completion", "bash"]).exit_code == 4


def test_wrong_usage_is_2() -> None:
    assert run("identify", "--model", "4", "a.mcap")[0] == 2
    assert run("fly")[0] == 2


def test_colours_on_a_terminal_only(tmp_path: Path) -> None:
    command = [LWR_RUN, "info", str(tmp_path / "none.mcap")]
    environment = {name: value for name, value in os.environ.items() if name not in ("CI", "NO_COLOR")}
    plain = subprocess.run(command, capture_output=True)
    assert b"\x1b[" not in plain.stderr
    assert plain.returncode == 2 or plain.returncode == 7
    leader, follower = pty.openpty()
    subprocess.run(command, stderr=follower, stdout=follower, env=environment | {"TERM": "xterm"})
    os.close(follower)
    shown = os.read(leader, 65536)
    os.close(leader)
    assert b"\x1b[31m" in shown


@pytest.mark.parametrize(
    ("typed", "wanted"),
    [
        (["lwr-run", "ide"], "identify"),
        (["lwr-run", "identify", "--estimator", "phy"], "physical"),
        (["lwr-run", "doctor", "--pe"], "--period-ms"),
    ],
)
def test_the_shell_completes_commands_options_and_choices(typed: list[str], wanted: str) -> None:
    environment = os.environ | {
        "_LWR_RUN_COMPLETE": "bash_complete",
        "COMP_WORDS": " ".join(typed),
        "COMP_CWORD": str(len(typed) - 1),
    }
    done = subprocess.run([LWR_RUN], env=environment, capture_output=True, text=True, check=True)
    assert wanted in {line.split(",")[-1] for line in done.stdout.splitlines()}


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_scripts_name_the_program(shell: str) -> None:
    code, text = run("completion", shell)
    assert code == 0
    assert f"_LWR_RUN_COMPLETE={shell}_complete" in text


def test_bash_takes_the_script(tmp_path: Path) -> None:
    _, text = run("completion", "bash")
    script = tmp_path / "completion.bash"
    script.write_text(text)
    subprocess.run(["bash", "-n", str(script)], check=True)


def test_json_is_always_valid() -> None:
    import numpy as np

    text = to_json(
        {"a": float("inf"), "b": np.array([1.0, np.nan]), "c": (Path("x"), np.int64(3), None, True)}
    )
    assert json.loads(text) == {"a": None, "b": [1.0, None], "c": ["x", 3, None, True]}


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_every_estimator_is_reached(estimator: str, workplace: Callable[[], Path]) -> None:
    place = workplace()
    write_settings(place, essential=None, covariance={"kind": "textbook"})
    code, text = run("identify", *SESSIONS, *SETTINGS, "--estimator", estimator, "--json")
    assert code == 0, text
    content = json.loads(text)
    masses = [entry["estimate"] for entry in content["parameters"] if entry["name"] == "M8"]
    assert content["essential"] is None
    # Some settle on a prior or are still under way; none may be far off.
    assert masses[0] == pytest.approx(3.34, abs=0.7)


def test_settings_reach_the_identification(workplace: Callable[[], Path]) -> None:
    place = workplace()
    write_settings(place, essential={"keep": ["MX7"], "drop": ["Fvl"]})
    code, text = run("identify", *SESSIONS, *SETTINGS, "--essential", "--out", "small.yaml")
    assert code == 0, text
    small = read_model(place / "small.yaml")
    assert "MX7" in {name.rstrip("R") for name in small.names}
    assert not [name for name in small.names if name.startswith("Fvl")]
    write_settings(
        place,
        essential=None,
        signals={"known_share": 0.3, "cutoff_hz": 8},
        coulomb={"kind": "tanh", "width": 0.01},
        without=["offl"],
        couplings=[["A5", "A6"]],
    )
    code, text = run("identify", *SESSIONS, *SETTINGS, "--json")
    assert code == 0, text
    content = json.loads(text)
    assert content["sessions"][0]["cutoff_hz"] == 8.0
    assert not [entry for entry in content["parameters"] if entry["name"].startswith("offl")]


def test_every_key_of_the_settings_reaches_the_identification(tmp_path: Path) -> None:
    path = tmp_path / "settings.yaml"
    content: dict[str, Any] = {
        "without": ["offm3"],
        "couplings": [["A5", "A6"]],
        "resonance_hz": 12.0,
        "coulomb": {"kind": "deadband", "width": 0.02},
        "covariance": {"kind": "bootstrap", "bandwidth_s": 0.5, "block_s": 2.0, "draws": 50, "seed": 3},
        "signals": {
            "cutoff_hz": 9.0, "order": 3, "decimate_hz": 3.0, "rate_hz": 6.0, "attenuation_db": 50.0,
            "average_periods": True, "edge_s": 0.4, "longest_bridge_s": 0.03,
            "reversal_s": 0.03, "turning_rad": 0.002, "slow_rad_s": 0.02, "standstill_rad_s": 0.003, "known_share": 0.5,
            "stiffness_nm_rad": [10000, 9000, 8000, 8000, 7000, 6000, 5000], "outlier_scale": 6.0,
            "motor_delay_s": 0.004, "joint_delay_s": -0.001, "delay_search_s": 0.05, "coupled": [["A1", "A2"]],
            "encoder": "motor",
        },
        "essential": {"significance": 0.05, "largest_loss_percent": 2.0, "keep": ["Fcm"], "drop": ["offl7"]},
    }  # fmt: skip
    path.write_text(yaml.safe_dump(content))
    found = dataclasses.asdict(IdentifySettings.load(path).identification(2, "wls"))
    assert (found["model"], found["estimator"]) == (2, "wls")
    assert found["couplings"] == ({"joints": ("A5", "A6")},)
    for name in set(content) - {"couplings"}:
        assert found[name] == read_back(content[name]), name
    options = {"tuning": 2.0, "memory_s": 8.0, "relative_noise": 0.01, "prior_strength": "evidence"}
    options |= {"prior_metric": "entropic", "prior_std": 0.1}
    for estimator, kind in ESTIMATORS.items():
        mine = {name: options[name] for name in kind.options}
        path.write_text(yaml.safe_dump({"estimator": mine}))
        built = IdentifySettings.load(path).identification(1, estimator).estimator
        assert isinstance(built, str) is not bool(mine)
    assert {name for kind in ESTIMATORS.values() for name in kind.options} == set(options)


def read_back(value: Any) -> Any:
    return (
        tuple(map(read_back, value))
        if isinstance(value, list)
        else ({key: read_back(item) for key, item in value.items()} if isinstance(value, dict) else value)
    )


def test_options_of_an_estimator_change_its_estimate(workplace: Callable[[], Path]) -> None:
    place = workplace()
    plain: dict[str, Any] = {"essential": None, "covariance": {"kind": "textbook"}}
    for estimator, options in (
        ("huber", {"tuning": 0.5}),
        ("recursive", {"memory_s": 2.0}),
        ("tls", {"relative_noise": 3e-4}),
        ("map", {"prior_strength": 9.0, "prior_metric": "euclidean", "prior_std": 0.05}),
    ):
        values = []
        for settings in (plain, {**plain, "estimator": options}):
            write_settings(place, **settings)
            code, text = run("identify", *SESSIONS, *SETTINGS, "--estimator", estimator, "--json")
            assert code == 0, text
            values.append([entry["estimate"] for entry in json.loads(text)["parameters"]])
        assert values[0] != values[1], estimator


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"estimator": {"tuning": 2.0}},
            "`estimator.tuning` is 2.0, an option of huber and tukey, not of auto",
        ),
        ({"couplings": [["A5", "A5"]]}, "has A5 twice in a pair"),
        ({"couplings": [["A5"]]}, "`couplings`[0]: expected 2 entries, found 1"),
        ({"coulomb": {"kind": "tanh"}}, "width 0.0 must be positive"),
        ({"essential": {"keep": ["M8"], "drop": ["M8"]}}, "in both"),
        ({"estimator": {"prior_strength": "much"}}, "'much' is not one of evidence, cross_validation"),
        ({"signals": {"cutof_hz": 8.0}}, "unknown key `cutof_hz`; did you mean `cutoff_hz`?"),
        ({"signals": {"known_share": 1.5}}, "`signals`: `known_share`: 1.5 is outside 0 to 1"),
        ({"covariance": {"block_s": 0.0}}, "`covariance`: `block_s`: 0.0 s is outside above 0 to 100000 s"),
        ({"covariance": {"draws": 2e6}}, "found the float 2000000.0; write 2000000"),
        ({"covariance": {"draws": 2000000}}, "is outside 2 to 1000000"),
        ({"covariance": {"draws": "1e3"}}, "write 1000"),
        (
            {"covariance": {"block_s": 900.0}},
            "`covariance`: `block_s`: 900.0 s is more than an eighth of all",
        ),
        ({"signals": {"edge_s": 100.0}}, "`signals`: `edge_s`: 100.0 s at either end leave nothing"),
        ({"signals": {"rate_hz": 0.001}}, "`signals`: `rate_hz`: 0.001 Hz makes fewer than 10 rows"),
        ({"signals": {"stiffness_nm_rad": [1.0]}}, "`stiffness_nm_rad` has 1 values for 7 joints"),
        ({"essential": {"keep": ["M99"]}}, "`keep` names 'M99', not a base parameter"),
        ({"without": ["M99"]}, "`without` names 'M99', not a parameter"),
        ({"couplings": [["A5", "A9"]]}, "`couplings` names joint 'A9', not one of"),
    ],
)
def test_settings_that_make_no_sense_are_refused(
    settings: dict[str, Any], message: str, workplace: Callable[[], Path]
) -> None:
    write_settings(workplace(), **settings)
    code, text = run("identify", *SESSIONS, *SETTINGS)
    assert code == 2
    said = " ".join(text.split())
    assert message in said
    assert re.search(r"settings\.yaml:\d+: `", said)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--payload", "other.mcap=block"], "write FILE=NAME"),
        (["--payload", "loaded.mcap=block:heavy"], "'heavy' is no mass in kg"),
        (["--payload", "loaded.mcap=block:-1"], "'-1' is no mass in kg; give a positive number"),
        (["--essential", *SETTINGS], "has `essential: null`; leave one out"),
        (["--settings", "none.yaml"], "file 'none.yaml' not found"),
    ],
)
def test_options_that_make_no_sense_are_refused(
    options: list[str], message: str, workplace: Callable[[], Path]
) -> None:
    write_settings(workplace(), essential=None)
    code, text = run("identify", *SESSIONS, *options)
    assert code == 2
    assert message in " ".join(text.split())


def test_a_failed_test_session_never_costs_the_model(workplace: Callable[[], Path]) -> None:
    place = workplace()
    write_settings(place, essential=None)
    command = ["identify", *SESSIONS, *SETTINGS, "--out", "m.yaml", "--test", "loaded.mcap"]
    code, text = run(*command)
    assert code == 7
    assert read_model(place / "m.yaml").value("M8") > 3.0
    assert "payload mass  3." in text
    assert re.search(r"torque error  .*joint \d\.\d\d % on data of the estimate", text)
    assert "\nM8 " in run("-v", *command, "--force")[1]
    assert "not validated: loaded.mcap: the model was fitted to this session" in " ".join(text.split())
    result = CliRunner().invoke(main, [*command, "--json", "--force"])
    assert result.exit_code == 7
    content = json.loads(result.stdout)
    assert (content["kind"], content["exit_code"]) == ("DataError", 7)
    assert content["unscored"][0]["session"] == "loaded.mcap"
    assert content["parameters"]


def test_the_payload_of_a_log_can_be_corrected(workplace: Callable[[], Path]) -> None:
    write_settings(workplace(), essential=None)
    code, text = run("identify", *SESSIONS, *SETTINGS, "--json", "--payload", "loaded.mcap=block:3.3")
    assert code == 0, text
    content = json.loads(text)
    assert [session["payload"] for session in content["sessions"]] == [None, "block"]
    assert [one["session"] for one in content["fit"]] == list(SESSIONS[:2])
    assert all(0.0 < one["torque_error"]["joint"] < 0.1 for one in content["fit"])


def test_json_of_recover_attach_and_export(workplace: Callable[[], Path]) -> None:
    place = workplace()
    code, text = run("recover", "broken.mcap", "--json")
    assert code == 0
    assert json.loads(text)["needed"] is True
    (place / "other" / "loaded.plain.mcap").rename(place / "bare.mcap")
    code, text = run("attach", "bare.mcap", "other/loaded.trace.csv", "--force", "--json")
    assert code == 0
    assert json.loads(text)["alignment"]["delay_std_s"] < 1e-3
    code, text = run("export", "model.yaml", "out.urdf", "out.c", "--json")
    assert [entry["format"] for entry in json.loads(text)["files"]] == ["URDF", "C"]


@pytest.mark.slow
@pytest.mark.usefixtures("few_figures")
def test_options_of_commands_for_logs(workplace: Callable[[], Path]) -> None:
    place = workplace()
    (place / "other" / "loaded.plain.mcap").rename(place / "bare.mcap")
    assert run("attach", "bare.mcap", "other/loaded.trace.csv", "--tolerance-ms", "1e-6", "--force")[0] == 7
    (place / "recording").mkdir()
    (place / "recording" / "arm.csv").write_text("t,q,tau\n0,0,1\n0.01,0.1,1.1\n0.02,0.2,1\n0.03,0.3,1\n")
    (place / "mapping.yaml").write_text(yaml.safe_dump(MAPPING))
    options = ["--rows", "1:3", "--serial", "12", "--payload", "block", "--payload-mass", "2.5"]
    code, text = run("import", "mapping.yaml", "recording", "imported.mcap", *options)
    assert code == 0, text
    content = json.loads(run("info", "imported.mcap", "--json")[1])
    assert content["metadata"]["serial"] == "12"
    assert (content["metadata"]["payload"], float(content["metadata"]["payload_mass"])) == ("block", 2.5)
    assert 2 in {channel["samples"] for channel in content["channels"]}
    assert "is no range of rows" in run("import", "mapping.yaml", "recording", "x.mcap", "--rows", "3")[1]
    options = ("--format", "svg", "--columns", "1", "--width", "100", "--joints", "names", "--statistics")
    code, text = run("report", "results", "--figures", "figures", *options, "--json")
    assert code == 0, text
    files = [Path(file) for file in json.loads(text)["figures"]]
    assert {file.suffix for file in files} == {".svg", ".tex"}
    assert 'width="283.46' in files[0].read_text()


@pytest.mark.slow
def test_options_of_commands_for_models(workplace: Callable[[], Path]) -> None:
    place = workplace()
    assert run("export", "model.yaml", "out.c", "--name", "bench", "--payload", "paper_load")[0] == 0
    assert "bench_" in (place / "out.c").read_text()
    code, text = run("compare", "model.yaml", "another_model.yaml", "--level", "0.5", "--json")
    assert (code, json.loads(text)["level"]) == (0, 0.5)
    held, free = (run("payload", "model.yaml", "loaded.mcap", *o, "--json") for o in ([], ["--free-offsets"]))
    assert held[0] == free[0] == 0
    assert held[1] != free[1]
    sessions = ["unloaded.mcap", "loaded.mcap", "--allow-seen"]
    code, text = run("validate", "model.yaml", *sessions, "--forward", "--cross", "--json")
    assert code == 0, text
    assert {"forward", "cross_validation"} <= set(json.loads(text))
    said = run("validate", "model.yaml", *sessions, "--forward", "--cross")[1]
    assert re.search(r"simulated +loaded\.mcap: torque error \d+\.\d\d %", said)
    assert re.search(r"left out in turn +\d sessions?[^:]*: torque error \d", said)
    (place / "slow.yaml").write_text("signals: {cutoff_hz: 3}\n")
    code, slow = run("validate", "model.yaml", *sessions, "--settings", "slow.yaml", "--json")
    assert code == 0, slow
    assert json.loads(slow)["sessions"] != json.loads(text)["sessions"]


def test_the_period_of_a_check(workplace: Callable[[], Path]) -> None:
    workplace()
    texts = [run("check", "my_lab.yaml", "--period-ms", period)[1] for period in ("5", "20")]
    assert texts[0] != texts[1]
