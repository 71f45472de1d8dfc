"""The doctor against the emulator, against nobody, against strangers, and on made-up links."""

from __future__ import annotations

import dataclasses
import json
import logging
import socket
import threading
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from fri.errors import NetworkError, RobotError
from fri.packets import MSR_ID, MSR_SIZE, new_msr
from lwr_driver.arm import Arm
from lwr_driver.link import LinkState
from runner.cli import main
from runner.computer import ComputerFinding, examine_computer, find_interface
from runner.doctor import Examination, Heard, LinkTest, Patient, judge_heard, judge_link, listen
from runner.laboratory import free_port

PATIENT = Patient(Arm.load(), "127.0.0.1", 49938, counter_int=1)


def doctor(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(main, ["doctor", *arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout


def by_subject(findings: Any) -> dict[str, Any]:
    return {f["subject"] if isinstance(f, dict) else f.subject: f for f in findings}


def state(**changes: Any) -> LinkState:
    seven = np.zeros(7)
    content: dict[str, Any] = {field.name: 0 for field in dataclasses.fields(LinkState)}
    content |= dict.fromkeys(("q", "tau", "tau_external", "q_command", "setpoint", "tracking_error"), seven)
    content |= {"state": "MON", "quality": "PERFECT", "control": "POSITION", "mode": "mirror", "left": ""}
    content |= {"period_s": 0.005, "answer_rate": 1.0, "power": 0x7F, "latency_s": {}, "age_s": 0.0}
    return LinkState(**(content | {"temperature": seven + 35.0} | changes))


def link_test(counts: dict[int, int] | None = None, fresh: int = 833, **end: Any) -> LinkTest:
    """Ten seconds at 5 ms; `counts` : answers by latency in microseconds."""
    edges = np.arange(1, 1002) * 2e-6
    histogram = np.zeros(1001, dtype=np.int64)
    for microseconds, count in (counts or {60: 2000}).items():
        histogram[min(microseconds // 2, 1000)] += count
    msr = new_msr()
    msr["krl_int"][15] = 1
    msr["krl_real"][7:11] = (3.34, 0.0, -66.0, 66.0)
    worst = end.pop("worst_quality", end.get("quality", "PERFECT"))
    return LinkTest(10.0, state(), state(**({"received": 2000} | end)), worst, edges, histogram, msr, fresh)


@pytest.mark.parametrize(
    ("latency_s", "jitter_s", "verdict"),
    [(0.0004, 0.0001, "ok"), (0.003, 0.0, "advice"), (0.001, 0.004, "advice"), (0.327, 0.0, "fail")],
)
def test_a_round_trip_longer_than_the_cycle_is_no_link(
    latency_s: float, jitter_s: float, verdict: str
) -> None:
    link = link_test(controller_latency_s=latency_s, jitter_s=jitter_s)
    found = by_subject(judge_link(PATIENT, link))["round trip"]
    assert found.verdict == verdict
    assert f"latency {1000 * latency_s:.2f} ms" in found.value
    assert found.limit == "below 2.5 ms, at most 5 ms"
    assert ("old packets" in found.advice) == (verdict == "fail")


def test_a_controller_that_measures_no_round_trip_is_not_judged_by_it() -> None:
    assert "round trip" not in by_subject(judge_link(PATIENT, link_test()))


@pytest.mark.slow
def test_the_emulator_is_found_and_tested(tmp_path: Path) -> None:
    code, text = doctor("--link", "--seconds", "0.5", "--period-ms", "20", "--json")
    content = json.loads(text)
    found = by_subject(content["findings"])
    assert code == content["exit_code"] == (0 if content["ready"] else 6)
    assert found["packets"]["value"] == "916 bytes, id 0x2006 from 127.0.0.1"
    assert {"interface", "port", "real-time rights", "kernel", "clock source", "disk", "versions"} <= set(
        found
    )
    assert {"rate", "losses", "reply", "answered in time", "quality", "state", "drives"} <= set(found)
    assert found["KRL program"]["verdict"] == "ok"
    assert content["link"]["period_s"] == 0.02
    assert sum(content["link"]["histogram"]["counts"]) > 10
    assert all({"value", "limit", "verdict", "advice"} <= set(item) for item in found.values())


def test_without_a_controller_it_says_what_is_awaited_seen_since_when_and_what_to_do() -> None:
    port = free_port("127.0.0.1")
    code, text = doctor("--link", "--address", "127.0.0.1", "--port", str(port), "--wait", "0.3")
    assert code == 6
    words = " ".join(text.split())
    assert f"none on UDP 127.0.0.1:{port} in 0.3 s" in words
    assert "At the pendant: select and start the KRL program (`lwr_identification`)" in words
    assert f"the host must be 127.0.0.1 and the port {port}" in words
    assert text.rstrip().endswith("Not ready: packets.")


def test_the_driver_is_heard_again_after_an_examination(caplog: pytest.LogCaptureFixture) -> None:
    doctor()
    logging.getLogger("lwr_driver.driver").warning("a stranger speaks")
    assert "a stranger speaks" in caplog.text


def test_this_computer_alone(tmp_path: Path) -> None:
    code, text = doctor("--json")
    found = by_subject(json.loads(text)["findings"])
    assert code == 0
    assert "packets" not in found
    assert "numpy" in found["versions"]["value"]


def test_an_address_of_nobody_and_a_port_in_use_are_said() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        found = by_subject(examine_computer("127.0.0.1", port, Path.cwd(), realtime=False))
        assert found["port"].verdict == "fail"
        assert f"ss -lunp | grep {port}" in found["port"].advice
        found = by_subject(examine_computer("192.0.2.7", port, Path.cwd(), realtime=False))
    assert found["interface"].verdict == "fail"
    assert "sudo ip address add 192.0.2.7/24 dev CARD (CARD of" in found["interface"].advice
    interface = find_interface("127.0.0.1")
    assert interface is not None
    assert interface.name == "lo"


def test_an_examination_stops_where_listening_makes_no_sense() -> None:
    code, text = doctor("--link", "--address", "192.0.2.7", "--wait", "30")
    assert code == 6
    assert "Not ready: interface, port" in text


def test_datagrams_of_something_else_are_described() -> None:
    port = free_port("127.0.0.1")
    stop = threading.Event()

    def send() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as end:
            while not stop.wait(0.02):
                end.sendto(b"\0" * 6 + b"\x01\x30" + b"\0" * 92, ("127.0.0.1", port))

    thread = threading.Thread(target=send)
    thread.start()
    heard = listen("127.0.0.1", port, None, 0.3)
    stop.set()
    thread.join()
    assert "of 100 bytes with id 0x3001 from 127.0.0.1" in str(heard)
    finding = judge_heard(PATIENT, heard, 10)[0]
    assert (finding.verdict, finding.who) == ("fail", NetworkError)
    assert "does not speak FRI 1.0" in finding.advice


def test_a_controller_elsewhere_or_two_of_them() -> None:
    kind = (MSR_SIZE, MSR_ID)
    patient = dataclasses.replace(PATIENT, controller="192.168.0.20")
    elsewhere = judge_heard(patient, Heard(1.0, Counter({("192.168.0.21", *kind): 3})), 3)[0]
    assert "set `link.controller` to 192.168.0.21" in elsewhere.advice
    two = Counter({("192.168.0.20", *kind): 3, ("192.168.0.21", *kind): 3})
    assert judge_heard(patient, Heard(1.0, two), 3)[0].verdict == "ok"
    assert judge_heard(PATIENT, Heard(1.0, two), 3)[0].verdict == "fail"
    assert "nothing at all" in judge_heard(PATIENT, Heard(9.0), 0)[0].advice
    assert "ufw allow 49938/udp" in judge_heard(PATIENT, Heard(9.0), 12)[0].advice


@pytest.mark.parametrize(
    ("link", "subject", "verdict"),
    [
        (link_test(), None, "ok"),
        (link_test(received=1500), "rate", "fail"),
        (link_test(lost=40, received=1960), "losses", "fail"),
        (link_test(lost=2, received=1998), "losses", "advice"),
        (link_test(malformed=1), "losses", "fail"),
        (link_test({60: 1900, 3000: 100}), "reply", "advice"),
        (link_test({60: 9900, 3000: 101}, received=10000, period_s=0.001), "reply", "fail"),
        (link_test({60: 9800, 600: 200}, received=10000, period_s=0.001), "reply", "fail"),
        (link_test(late=200), "answered in time", "fail"),
        (link_test(late=50), "answered in time", "advice"),
        (link_test(quality="BAD"), "quality", "fail"),
        (link_test(worst_quality="BAD"), "quality", "advice"),
        (link_test(control="JNT_IMP"), "state", "advice"),
        (link_test(error=4), "drives", "fail"),
        (link_test(power=0), "drives", "advice"),
        (link_test(temperature=np.full(7, 75.0)), "temperature", "advice"),
        (link_test(fresh=0), "motor torques", "fail"),
        (link_test(fresh=50), "motor torques", "advice"),
    ],
)
def test_one_trouble_is_one_finding(link: LinkTest, subject: str | None, verdict: str) -> None:
    found = judge_link(PATIENT, link)
    others = {f.subject for f in found if f.verdict != "ok"}
    related = {"answered in time"} if subject == "losses" else set()
    assert others - related == (set() if subject is None else {subject})
    if subject is not None:
        assert by_subject(found)[subject].verdict == verdict
        assert by_subject(found)[subject].advice


def test_load_data_and_a_foreign_program_are_told() -> None:
    found = by_subject(judge_link(PATIENT, link_test()))
    assert found["load data"].value == "3.340 kg at (0, -66, 66) mm from the flange"
    other = judge_link(dataclasses.replace(PATIENT, handshake="stanford"), link_test())
    program = by_subject(other)["KRL program"]
    assert (program.verdict, program.who) == ("fail", RobotError)


def test_exit_code_is_that_of_the_first_failure_and_the_histogram_adds_up() -> None:
    link = link_test({10: 500, 150: 1499, 9000: 1}, error=1)
    whole = Examination(tuple(judge_link(PATIENT, link)), link)
    assert whole.exit_code == RobotError.exit_code
    assert whole.verdict == "Not ready: drives."
    lines = [line for line in str(whole).splitlines() if line.startswith(("  to ", "  over "))]
    assert sum(int(line.split()[3]) for line in lines) == 2000
    assert lines[-1].split() == ["over", "2000", "µs", "1", "0.050"]
    assert Examination((ComputerFinding("a", "b", "c", "advice", "d"),)).exit_code == 0


def test_options_that_contradict_each_other_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "lab.yaml"
    file.write_text(yaml.safe_dump({"name": "lab", "backend": "fri", "lock_step": False}))
    result = CliRunner().invoke(main, ["doctor", str(file), "--link", "--period-ms", "5"])
    assert result.exit_code == 2
    assert "--period-ms is for the emulator" in result.output
