"""A diagnosis in words: the same statements for terminal, report and notebook."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from ident.diagnosis.outcome.claims_in_words import SURE, is_open
from ident.diagnosis.outcome.statements import statements
from runner.ending import of_diagnosis
from runner.experiment_file import DiagnosisPlan
from runner.report.diagnosis import DiagnosisFolder
from runner.report.page import diagnosis_html

NAMES = ("A1", "A2", "E1", "A3", "A4", "A5", "A6")
FINDING: dict[str, Any] = {
    "cause": "viscous_nonlinear",
    "side": "motor",
    "joints": [2],
    "parameters": {"exponent": {"value": 0.7, "std": 0.02, "unit": "1"}},
    "evidence": {"test_rms_before": 0.61, "test_rms_after": 0.34, "gain_interval_95": [0.22, 0.31]},
    "confidence": 0.85,
    "alternatives": [{"cause": "stribeck", "joints": [2], "delta_bic": -102.0}],
    "tell_apart": "a slow sweep of joint 2",
}
CONTENT: dict[str, Any] = {
    "sessions": {"train": ["a.mcap"], "test": ["b.mcap"]},
    "findings": [FINDING],
    "unexplained": [],
    "gain": {
        "test_rms_base": {"motor": [0.5] * 7},
        "test_rms_extended": {"motor": [0.5, 0.25, *[0.5] * 5]},
        "simulation_error_base": {"position": [1e-3] * 7, "motor": None, "joint": None},
        "simulation_error_extended": {"position": [2e-3] * 7, "motor": None, "joint": None},
    },
}


def details(**changes: Any) -> dict[str, Any]:
    return {"joints": list(NAMES), "notes": ["one session only"], **changes}


def test_terminal_and_report_say_the_same(tmp_path: Path) -> None:
    (tmp_path / "diagnosis.json").write_text(json.dumps(CONTENT))
    (tmp_path / "details.json").write_text(json.dumps(details()))
    said = statements(CONTENT, details(), NAMES)
    page, text = diagnosis_html(DiagnosisFolder.load(tmp_path)), " ".join(said.text().split())
    assert said.headline == "One cause found"
    for sentence in (
        said.headline,
        "Viscous nonlinear, joint A2",
        "error on held-out data, by this cause alone",
        "a.mcap",
        "Root mean square errors below are on held-out data: b.mcap.",
        "measured minus simulated",
        "session only",
    ):
        assert sentence in text, sentence
        assert sentence in page, sentence


def test_the_confidence_that_counts_as_sure_is_a_setting() -> None:
    assert DiagnosisPlan().sure == SURE
    assert is_open(0.85, FINDING["alternatives"], 0.9)
    assert not is_open(0.5, [], 0.9)
    said = statements(CONTENT, details(sure=0.9), NAMES)
    assert said.headline == "One cause found, open between look-alikes"
    assert "could also be: stribeck, joint A2" in said.text()
    assert "could also be" not in statements(CONTENT, details(sure=0.8), NAMES).text()


PAIR: dict[str, Any] = {
    "finding": 1, "causes": [{"cause": "viscous_nonlinear", "joints": [2]}, {"cause": "stribeck", "joints": [2]}],
    "overlap": 0.66, "strength": [10.0, 8.0], "apart": 7.7, "needed": 4.7, "told_apart": True, "shape_alone": False,
    "decides": ["a slow sweep", "another"], "foreseen": None,
}  # fmt: skip


@pytest.mark.parametrize(
    ("apart", "headline"), [(True, "may be none of the look-alikes"), (False, "between look-a")]
)
def test_an_unsure_finding_told_apart_from_its_look_alikes_is_not_open_between_them(
    apart: bool, headline: str
) -> None:
    pair = {**PAIR, "told_apart": apart}
    said = statements(CONTENT, details(sure=0.9, look_alikes=[pair]), NAMES)
    text = " ".join(said.text().split())
    assert headline in said.headline
    assert headline in said.findings[0].confidence
    assert ("these sessions do; the cause may be neither" in text) == apart
    assert ("open between look-alikes" in text) != apart


@pytest.mark.parametrize(("reference", "owner"), [(True, "the healthy arm's"), (False, "the model's")])
def test_a_compliance_is_told_as_an_increase(reference: bool, owner: str) -> None:
    compliance = {"compliance": {"value": 2.5e-4, "std": 1e-5, "unit": "rad/Nm"}}
    soft = {**FINDING, "cause": "joint_elasticity", "parameters": compliance, "form": "encoder at the motor"}
    (said,) = statements({**CONTENT, "findings": [soft]}, details(reference=reference), NAMES).findings
    assert f"compliance 0.00025 ± 1e-05 rad/Nm more than {owner}" in said.text


@pytest.mark.parametrize(
    ("share", "healthy", "unexplained", "level", "headline"),
    [
        (0.1, None, None, "good", "No model error is detectable in these data"),
        (0.6, None, None, "look", "up to 60 % of the error's power on held-out data is above the noise"),
        (0.6, 0.21, None, "good", "No cause found, and no more error on held-out data than on the healthy days"),
        (0.6, 0.19, None, "good", "No cause found, and hardly more error on held-out data than on the healthy days"),
        (0.6, 0.14, None, "look", "up to 51 % of the error's power on held-out data is above that of the healthy days"),
        (0.1, 0.12, None, "good", "No model error is detectable in these data"),
        (0.1, 0.05, [], "look", "The data support no cause, but the error is far beyond that of the healthy days"),
        (0.1, None, ["q3"], "look", "The data support no cause, but the residuals depend on the motion"),
        (0.1, None, ["q3", "time"], "look", "The data support no cause, but the residuals depend on the motion"),
        (0.1, None, ["time"], "look", "The data support no cause, but the residuals change with the time and not"),
    ],
)  # fmt: skip
def test_a_diagnosis_without_findings_says_why(
    share: float, healthy: float | None, unexplained: list[str] | None, level: str, headline: str
) -> None:
    rest = [{"side": "motor", "joint": 3, "depends_on": unexplained, "test_rms": 0.2, "noise_floor": 0.1}]
    content = {**CONTENT, "findings": [], "unexplained": rest * (unexplained is not None)}
    row = {"side": "motor", "joint": 1, "avoidable_share": share, "gain_interval_95": [0.0, 0.0]}
    rows = [{**row, "healthy": healthy, "test_rms_base": 0.2}]
    said = statements(content, details(rows=rows), NAMES)
    assert said.level == level
    assert headline in said.headline
    assert ("E1 motor" in said.brief()) == (unexplained is not None)


def test_a_notebook_shows_ten_lines_at_most() -> None:
    said = statements({**CONTENT, "findings": [FINDING] * 12}, details(), NAMES)
    assert len(said.brief().splitlines()) == 10
    assert said.brief().endswith("more lines")


def test_an_extended_model_without_the_causes_and_rows_that_it_worsens_are_named() -> None:
    row = {
        "side": "motor",
        "joint": 3,
        "noise_floor": 0.1,
        "test_rms_base": 0.5,
        "test_rms_extended": 0.52,
        "gain": -0.02,
        "gain_interval_95": [-0.03, -0.01],
        "avoidable": 0.0,
        "avoidable_share": 0.0,
    }
    # Half a per cent is felt by nobody, however sure.
    rows = [row, {**row, "joint": 4, "test_rms_extended": 0.5025}]
    said = statements(CONTENT, details(rows=rows), NAMES)
    line = next(one for one in said.lines if one.subject == "extended model")
    assert line.found.endswith("; worse: E1 motor")
    said = statements({**CONTENT, "extension": []}, details(rows=rows), NAMES)
    line = next(one for one in said.lines if one.subject == "extended model")
    assert (
        line.found
        == "the base model: no cause here is a term that lasts and lessens the error of further sessions"
    )
    assert (line.wanted, line.level) == ("", "good")


def test_the_gain_of_test_sessions_has_all_samples_first_and_then_the_rows() -> None:
    rows = {"rows_base": {"motor": [0.2] * 7}, "rows_extended": {"motor": [0.18] * 7}}
    content = {
        **CONTENT,
        "gain": {**CONTENT["gain"], **rows},
        "baseline": {"noise_floor": {"motor": [0.1] * 7}},
    }
    row = {"side": "motor", "joint": 2, "gain_interval_95": [0.01, 0.03], "avoidable_share": 0.75}
    said = statements(
        content, details(rows=[{**row, "test_rms_base": 0.2, "test_rms_extended": 0.18}]), NAMES
    )
    gain = next(part for part in said.parts if part.anchor == "gain")
    told = dict(zip(gain.head, map(str, gain.rows[1]), strict=True))
    assert list(told.values()) == [
        "A2 motor", "0.5000", "0.2500", "-50.0", "0.1000", "0.2000", "0.1800", "+0.0100 to +0.0300", "75"
    ]  # fmt: skip
    assert list(told)[:5] == ["rms [Nm]", "base", "extended", "change %", "rows: noise"]
    told = statements(content, details(rows=[{**row, "healthy": 0.11, "test_rms_base": 0.2}]), NAMES)
    gain = next(part for part in told.parts if part.anchor == "gain")
    assert gain.head[gain.head.index("rows: noise") + 1] == "healthy, at most"
    assert "0.1100" in map(str, gain.rows[1])
    table = [line for line in said.text().splitlines() if "avoidable %" in line or " motor  " in line]
    assert len(table) == 8
    assert max(map(len, table)) <= 115
    # The figures in short are of all samples.
    assert "A2 motor -50 %" in said.brief()
    alone = statements({**content, "sessions": {"train": ["a.mcap"], "test": []}}, details(), NAMES).text()
    assert "noise [Nm]" in alone
    assert "rows:" not in alone


def test_what_the_healthy_arm_has_is_told_in_a_line(tmp_path: Path) -> None:
    own = [
        ("stribeck", [2]),
        ("presliding_hysteresis", [1]),
        ("presliding_hysteresis", [1]),
        ("stribeck", [4]),
    ]
    healthy = [
        {"cause": cause, "joints": joints, "parameters": {}} for cause, joints in [*own, ("base_tilt", [])]
    ]
    content = {**CONTENT, "healthy": healthy}
    line = "The healthy arm has: stribeck (A2, A3); presliding hysteresis (A1); base tilt."
    assert line in statements(content, details(), NAMES).text().splitlines()
    assert "healthy arm has" not in statements({**content, "healthy": []}, details(), NAMES).text()
    (tmp_path / "diagnosis.json").write_text(json.dumps(content))
    (tmp_path / "details.json").write_text(json.dumps(details()))
    assert line in diagnosis_html(DiagnosisFolder.load(tmp_path))


def test_a_worse_replay_is_pointed_out() -> None:
    line = next(one for one in statements(CONTENT, details(), NAMES).lines if one.anchor == "replay")
    assert line.level == "look"
    assert "position 2.65 -> 5.29 mrad" in line.found


def test_a_cause_on_the_links_is_in_the_torques_that_there_are() -> None:
    tilt = {**FINDING, "cause": "base_tilt", "side": "joint", "joints": [], "parameters": {}}
    for motor, both in (([0.1] * 7, True), (None, False)):
        floors = {"motor": motor, "joint": [0.1] * 7}
        content = {**CONTENT, "findings": [tilt], "baseline": {"noise_floor": floors}}
        (finding,) = statements(content, details(), NAMES).findings
        assert "Acts on the links" in finding.text
        assert ("both torques see it" in finding.text) == both


def test_a_moment_is_told_with_the_name_of_its_session() -> None:
    contact = FINDING | {
        "cause": "contact",
        "joints": [],
        "side": "joint",
        "parameters": {
            name: {"value": value, "std": 0.1, "unit": unit}
            for name, value, unit in (
                ("force_x", 20.0, "N"),
                ("force_y", 0.0, "N"),
                ("force_z", 0.0, "N"),
                ("time", 4.0, "s"),
                ("duration", 1.0, "s"),
                ("session", 2.0, "1"),
                ("link", 7.0, "1"),
            )
        },
    }
    said = statements(CONTENT | {"findings": [contact]}, details(sessions=["late.mcap", "early.mcap"]), NAMES)
    assert "of early.mcap" in said.text()


def test_channels_in_doubt_are_in_the_short_text_with_what_they_look_like(tmp_path: Path) -> None:
    what = "contradicts the other channels, looks like the two joints interchanged"
    doubts = [{"channel": "motor torque", "joint": joint, "what": what, "advice": ""} for joint in (1, 3, 3)]
    said = statements({**CONTENT, "findings": []}, details(in_doubt=doubts), NAMES)
    line = next(one for one in said.lines if one.subject == "channels in doubt")
    assert line.found == "A1, E1 motor torque (the two joints interchanged)"
    assert line.level == said.level == "look"
    (verdict,) = [one for one in of_diagnosis(said, None, tmp_path).look if one.subject == line.subject]
    assert verdict.found == line.found
