"""What is said while something is awaited: what it is, what is seen, since when, what to do."""

from __future__ import annotations

import dataclasses
import io
from typing import Any

import click
import numpy as np
import pytest

from fri.errors import OperatorError
from lwr_driver.driver import Waiting
from lwr_driver.link import (
    LinkState,
    advise_command,
    advise_connect,
    advise_leave,
    advise_load,
    advise_monitor,
    advise_quality,
    advise_rest,
)
from runner.experiment_file import Experiment, Payload
from runner.laboratory import Laboratory, Person
from runner.status import StatusLine

ADVICE = (
    advise_command,
    advise_connect,
    advise_leave,
    advise_load,
    advise_monitor,
    advise_quality,
    advise_rest,
)


def link(**changes: Any) -> LinkState:
    seven = np.zeros(7)
    content: dict[str, Any] = {field.name: 0 for field in dataclasses.fields(LinkState)}
    content |= dict.fromkeys(("q", "tau", "tau_external", "q_command", "setpoint", "tracking_error"), seven)
    content |= {"state": "MON", "quality": "PERFECT", "control": "POSITION", "mode": "mirror", "left": ""}
    content |= {"sequence": 500, "received": 500, "answer_rate": 1.0, "power": 0x7F, "temperature": seven}
    return LinkState(**(content | changes))


@pytest.mark.parametrize("advise", ADVICE)
def test_during_silence_every_step_sends_the_person_to_the_pendant(advise: Any) -> None:
    assert "pendant" in advise(link(age_s=5.0))


@pytest.mark.parametrize(
    ("advise", "state", "words"),
    [
        (advise_monitor, {}, "Nothing to do"),
        (advise_rest, {}, "emergency stop"),
        (advise_leave, {}, "stop it at the pendant"),
        (advise_load, {}, "LWR_LOAD_MAX"),
        (advise_quality, {}, "cable"),
        (advise_quality, {"late": 50}, "Answers come too late"),
        (advise_quality, {"foreign": 3}, "Another address sends too"),
        (advise_command, {}, "At the pendant: start the KRL program"),
        (advise_command, {"state": "CMD", "power": 0x3F}, "switch the drives on"),
        (advise_command, {"control": "JOINT_IMPEDANCE"}, "$STIFFNESS.STRATEGY=10"),
        (advise_command, {"quality": "BAD", "late": 50}, "Answers come too late"),
        (advise_connect, {"sequence": -1, "malformed": 3}, "not FRI 1.0"),
        (advise_connect, {"sequence": -1}, "FRIHOST"),
    ],
)
def test_advice_fits_what_is_seen(advise: Any, state: dict[str, Any], words: str) -> None:
    assert words in advise(link(**state))


def test_waiting_says_once_what_is_awaited_and_what_to_do() -> None:
    shown = io.StringIO()
    experiment = Experiment.load().changed(backend="fri", lock_step=False)
    laboratory = Laboratory(experiment, status=StatusLine(shown))
    for since in (1.0, 1.5, 12.0):
        laboratory._notify(Waiting("command mode with drives on", "state MON", since, "Do this"))
    laboratory._notify(Waiting("command mode with drives on", "state CMD", 13.0, "Do that"))
    said = "waiting for command mode with drives on. "
    assert shown.getvalue() == f"{said}Do this\n{said}Do that\n"


def test_nobody_is_sent_to_the_pendant_of_the_emulator() -> None:
    shown = io.StringIO()
    Laboratory(Experiment.load(), status=StatusLine(shown))._notify(Waiting("x", "y", 12.0, "Do this"))
    assert shown.getvalue() == ""


def test_the_person_is_asked_for_the_payload_with_its_load_data(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[str] = []

    def confirm(question: str, **named: Any) -> bool:
        asked.append(question)
        return False

    monkeypatch.setattr(click, "confirm", confirm)
    with pytest.raises(OperatorError, match="nothing moved"):
        Person(False).swap(None, Payload("block", 2.0, (0.0, -0.066, 0.144)))
    assert asked == ["Ready?"]
    assert " ".join(capsys.readouterr().err.split()) == (
        "Mount the payload 'block', 2 kg, then enter its load data on the controller: 2 kg, centre of mass "
        "(0, -66, 144) mm in the frame of link 7. Stay clear of the arm."
    )
    with pytest.raises(OperatorError):
        Person(False).start_trace()
    assert asked[1] == "Running?"
    assert "Start the controller's trace" in capsys.readouterr().err
