"""Causes that look alike: shown side by side, with the motion that decides."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fri.errors import ConfigurationError, DataError
from ident.diagnosis.outcome.claims_in_words import comparison
from ident.diagnosis.outcome.look_alikes import LookAlikes
from ident.dynamics.kinematics import Chain
from ident.effects import Discriminator
from ident.excitation import ExcitationPlan
from ident.excitation.motions import SplineMotion
from lwr_driver.session import Session
from runner.diagnosis import Study, asked, study
from runner.diagnosis.discriminating import Discriminating
from runner.diagnosis.records import LOOK_ALIKES, read_look_alikes
from runner.diagnosis.study import replaceable
from runner.report.diagnosis import DiagnosisFolder, diagnosis_paper_figures
from runner.report.diagnosis_figures import look_alike_figure
from runner.report.page import diagnosis_html

Make = Callable[..., Session]
NAMES = ("one", "two", "three")


@pytest.fixture(scope="module")
def found(make: Make, chain: Chain) -> Study:
    """An error of the last joint's sensor that repeats with the angle; without a motor torque a doubt remains."""

    def ripple(s: dict[str, np.ndarray]) -> None:
        s["joint"][:, 2] += 0.15 * np.cos(2.0 * s["q"][:, 2])

    logs = [replace(make("a.mcap", 1, ripple), motor=None)]
    pairs = [(asked("cable_spring:three", NAMES), asked("joint_zero_offset(2)", NAMES))]
    return study(logs, chain, simulate=False, compare=pairs)


def test_a_doubt_is_shown_with_both_signatures(found: Study) -> None:
    finding = found.diagnosis.claims[0]
    assert (finding.cause, finding.joints) == ("sensor_ripple", (3,))
    assert finding.confidence < 0.8
    pair = found.pairs[0]
    assert (pair.finding, pair.first) == (1, (finding.cause, finding.joints))
    assert pair.second == finding.alternatives[0][:2]
    assert pair.strength[0] > 10.0
    assert 0.0 < pair.alike < 1.0
    assert pair.apart == pytest.approx(pair.strength[0] * np.sqrt(1.0 - pair.alike**2))
    trace = pair.traces[0]
    assert (trace.side, trace.joint) == ("joint", 3)
    # What the cause leaves is what was measured beside the model without it.
    assert np.corrcoef(trace.first, trace.measured)[0, 1] > 0.8
    said = str(found)
    assert f"overlap {pair.alike:.3f}" in said
    assert "Side by side: cable spring (joint three) or joint zero offset (joint two)" in said


def test_what_a_motion_will_tell_is_foreseen(found: Study) -> None:
    pair = found.pairs[0]
    share = np.linspace(0.0, 1.0, 120)
    points = np.zeros((3, 120))
    # Slowly over a wide range, which the session does not cover.
    points[2] = 2.6 * np.sin(4.0 * np.pi * share) * np.minimum(1.0, 20.0 * np.minimum(share, 1.0 - share))
    plan = ExcitationPlan(SplineMotion(24.0, points), NAMES, 1)
    sweep = Discriminating(
        "slow_sweep_3", Discriminator.SLOW_SWEEP, 3, plan, (None,), (pair.first, pair.second)
    )
    again = found.with_offers([sweep]).pairs
    seen = again[0].foreseen
    assert seen is not None
    assert seen.file == "slow_sweep_3.plan.yaml"
    assert seen.apart > 1.5 * pair.apart
    assert seen.alike < pair.alike
    assert again[1].foreseen is None
    assert f"{seen.apart:.2g} times the noise" in " ".join(str(found.with_offers([sweep])).split())


def test_the_figure_shows_both_over_time_and_against_what_they_depend_on(found: Study) -> None:
    figure = look_alike_figure(found.pairs[0], NAMES)
    assert {panel.x_label for panel in figure.panels} >= {
        "time [s], measured as means of 0.25 s",
        "position of three [rad]",
    }
    for panel in figure.panels:
        assert len(panel.marks) == 3
        assert "overlap" in panel.alt
        assert "Nm rms" in panel.alt


def test_the_files_and_the_page_hold_the_pairs(found: Study, tmp_path: Path) -> None:
    found.write(tmp_path)
    folder = DiagnosisFolder.load(tmp_path)
    assert [pair.to_dict() for pair in folder.look_alikes] == [pair.to_dict() for pair in found.pairs]
    np.testing.assert_allclose(
        folder.look_alikes[0].traces[0].first, found.pairs[0].traces[0].first, atol=1e-6
    )
    figures = [one.name for one in diagnosis_paper_figures(folder)]
    assert sum(name.startswith("look-alike-") for name in figures) == len(found.pairs)
    page = diagnosis_html(folder)
    assert page.count("Side by side:") == len(found.pairs)
    assert "To decide" in page
    assert folder.statements.lines[0].subject.startswith("sensor ripple, joint three")
    replaceable(tmp_path)
    (tmp_path / LOOK_ALIKES).write_bytes(b"PK")
    entries = json.loads((tmp_path / "details.json").read_text())["look_alikes"]
    with pytest.raises(DataError, match="run the diagnosis again"):
        read_look_alikes(tmp_path / LOOK_ALIKES, entries)


def test_a_folder_of_something_else_is_left_alone(tmp_path: Path) -> None:
    replaceable(tmp_path / "new")
    replaceable(tmp_path)
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(ConfigurationError, match="other files than a diagnosis"):
        replaceable(tmp_path)
    with pytest.raises(ConfigurationError, match="is a file"):
        replaceable(tmp_path / "thesis.tex")


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("cable_spring(3)", ("cable_spring", (3,))),
        ("cable_spring:two", ("cable_spring", (2,))),
        (" stribeck ( one ) ", ("stribeck", (1,))),
        ("base_tilt", ("base_tilt", ())),
    ],
)
def test_causes_are_asked_for_by_number_or_name(text: str, place: tuple[str, tuple[int, ...]]) -> None:
    assert asked(text, NAMES) == place


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("stribek:1", "did you mean"),
        ("stribeck", "belongs to a joint"),
        ("stribeck:9", "1 to 3 or one of one, two, three"),
        ("stribeck(1", "such as cable_spring:5"),
    ],
)
def test_wrong_causes_and_joints_are_named(text: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        asked(text, NAMES)


def test_what_the_overlap_means_is_said_in_words() -> None:
    alike = LookAlikes(
        1,
        ("cable_spring", (1,)),
        ("sensor_ripple", (1,)),
        0.999,
        (20.0, 20.0),
        ("position",) * 2,
        ("move joint 1",) * 2,
    )
    assert alike.apart < alike.needed
    said = comparison(alike.to_dict(), NAMES)
    assert said.overlap.endswith("not with these sessions")
    assert said.decides == "move joint one"
    apart = replace(alike, alike=0.3)
    assert comparison(apart.to_dict(), NAMES).overlap.endswith("these sessions do")
    assert "without a motor torque" in comparison(replace(apart, shape_alone=True).to_dict(), NAMES).overlap
