"""The doctor: examination of this computer, the link and the controller, each item with limit and advice.

For the link, the port is first observed without an answer, to recognise any sender. Then the driver's own loop
answers for some seconds in monitor mode, without motion.
"""

from __future__ import annotations

import socket
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fri.errors import LwrError, NetworkError, RobotError
from fri.handshake import IdentificationHandshake, find_handshake
from fri.packets import MSR_ID, MSR_SIZE
from fri.states import ALL_DRIVES
from lwr_driver.arm import Arm
from lwr_driver.driver import Driver, LinkSettings, LinkState
from lwr_driver.link import advise_quality
from lwr_driver.listing import Listing, Piece, text_of
from runner.computer import ComputerFinding, examine_computer, find_interface, graded

_HEADER = np.dtype([("send_seq", "<u2"), ("refl_seq", "<u2"), ("packet_size", "<u2"), ("datagram_id", "<u2")])
_LARGEST = 65535
_SLICE_S = 0.2
_REPORT_S = 0.5
_GOOD_SHARE = 0.99
_POOR_SHARE = 0.95
_WARM = 60.0
# Upper edges of the printed histogram [us].
_STEPS = (20.0, 50.0, 100.0, 200.0, 500.0, 1000.0, 2000.0)
_BAR = 18
_QUANTILES = (0.5, 0.99, 0.999)
_RANKS = ("UNACCEPTABLE", "BAD", "OK", "PERFECT")


@dataclass(frozen=True)
class Heard:
    """Datagrams received without an answer.

    kinds : counts by (source address, bytes, datagram id); the id is -1 for datagrams too short for one.
    """

    waited_s: float
    kinds: Counter[tuple[str, int, int]] = field(default_factory=Counter)

    @property
    def fri(self) -> tuple[str, ...]:
        """Senders of FRI 1.0."""
        return tuple(sorted({k[0] for k in self.kinds if k[1:] == (MSR_SIZE, MSR_ID)}))

    def __str__(self) -> str:
        if not self.kinds:
            return "nothing"
        return ", ".join(
            f"{count} datagrams of {size} bytes with {f'id 0x{number:04x}' if number >= 0 else 'no id'} from {source}"
            for (source, size, number), count in self.kinds.most_common(4)
        )


def listen(
    address: str,
    port: int,
    controller: str | None,
    wait_s: float,
    report: Callable[[float, Heard], None] | None = None,
) -> Heard:
    """Wait for an FRI packet of the controller, at most `wait_s`, without an answer.

    report : called about twice a second with the elapsed time and the datagrams so far.
    """
    kinds: Counter[tuple[str, int, int]] = Counter()
    began = time.monotonic()
    reported = began
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as end:
        end.bind((address, port))
        while True:
            waited = time.monotonic() - began
            heard = Heard(waited, kinds)
            if waited >= wait_s or (heard.fri and (controller is None or controller in heard.fri)):
                return heard
            if report is not None and time.monotonic() - reported >= _REPORT_S:
                reported = time.monotonic()
                report(waited, heard)
            end.settimeout(max(1e-3, min(_SLICE_S, wait_s - waited)))
            try:
                datagram, source = end.recvfrom(_LARGEST)
            except TimeoutError:
                continue
            whole = len(datagram) >= _HEADER.itemsize
            number = int(np.frombuffer(datagram, _HEADER, 1)[0]["datagram_id"]) if whole else -1
            kinds[(source[0], len(datagram), number)] += 1


@dataclass(frozen=True, eq=False)
class LinkTest:
    """The link over `seconds`, with every packet answered by its mirror.

    start, end : states before and after. worst_quality : lowest quality. edges, counts : histogram of the reply
    latency, upper edges [s]. msr : the last packet, dtype `fri.packets.MSR`, shape (). fresh : increments of the
    motor torques' counter, None without one. trouble : error at an early end.
    """

    seconds: float
    start: LinkState
    end: LinkState
    worst_quality: str
    edges: NDArray[np.float64]
    counts: NDArray[np.int64]
    msr: Any
    fresh: int | None = None
    trouble: LwrError | None = None

    @property
    def packets(self) -> int:
        """Packets received in the time."""
        return self.between("received")

    @property
    def rate_hz(self) -> float:
        """Packets a second."""
        return self.packets / self.seconds if self.seconds > 0.0 else 0.0

    def between(self, name: str) -> int:
        """Growth of a counter of the link, such as `lost`."""
        return int(getattr(self.end, name) - getattr(self.start, name))

    @property
    def in_time(self) -> float:
        """Share of the cycles answered before the controller's next packet."""
        cycles = self.packets + self.between("lost")
        return 1.0 - min(1.0, (self.between("late") + self.between("lost")) / cycles) if cycles else 0.0


def exercise(
    driver: Driver,
    seconds: float,
    *,
    counter_int: int | None = None,
    report: Callable[[float, LinkState], None] | None = None,
) -> LinkTest:
    """Test the link of a connected driver for `seconds`. Nothing is commanded."""
    first = driver.state()
    # The controller rates the last hundred packets, so the beginning is left out.
    settle = max(100, round(0.5 / first.period_s))
    trouble: LwrError | None = None
    worst, count_before, start = len(_RANKS) - 1, 0, first
    _, counts_before = driver.latency_histogram()
    began = time.monotonic()
    try:
        driver.monitor(settle)
        start = driver.state()
        _, counts_before = driver.latency_histogram()
        count_before = _count(driver, counter_int)
        began = time.monotonic()
        while time.monotonic() - began < seconds:
            driver.monitor(max(1, round(_REPORT_S / start.period_s)))
            state = driver.state()
            worst = min(worst, _RANKS.index(state.quality))
            if report is not None:
                report(time.monotonic() - began, state)
    except LwrError as error:
        trouble = error
    elapsed = time.monotonic() - began
    end = driver.state()
    edges, counts = driver.latency_histogram()
    fresh = None if counter_int is None else _count(driver, counter_int) - count_before
    rows = driver.last_rows(1)
    return LinkTest(
        elapsed, start, end, _RANKS[worst], edges, counts - counts_before, rows[0]["msr"], fresh, trouble
    )


def _count(driver: Driver, counter_int: int | None) -> int:
    rows = driver.last_rows(1)
    return 0 if counter_int is None or not len(rows) else int(rows[0]["msr"]["krl_int"][counter_int - 1])


@dataclass(frozen=True)
class Patient:
    """This computer's end of the link, and the expected controller.

    counter_int : index of the motor torques' counter in `$FRI_TO_INT`, None without motor torques.
    realtime : real-time rights are needed.
    """

    arm: Arm
    address: str
    port: int
    controller: str | None = None
    handshake: str = "lwr_identification"
    counter_int: int | None = None
    folder: Path = Path("experiments")
    realtime: bool = True


@dataclass(frozen=True)
class Examination:
    """All findings, and the link test if requested."""

    findings: tuple[ComputerFinding, ...]
    link: LinkTest | None = None

    @property
    def exit_code(self) -> int:
        """Exit code of the first failure, else 0."""
        return next((f.who.exit_code for f in self.findings if f.verdict == "fail"), 0)

    @property
    def verdict(self) -> str:
        """One sentence."""
        failed = [f.subject for f in self.findings if f.verdict == "fail"]
        noted = [f.subject for f in self.findings if f.verdict == "advice"]
        if failed:
            return f"Not ready: {', '.join(failed)}."
        return f"Ready. Better with: {', '.join(noted)}." if noted else "Ready."

    def pieces(self) -> list[Piece]:
        """The findings as a table, advice, times of the answers, verdict."""
        lines: list[Piece] = [
            Listing(
                ("subject", "", "found", "wanted"),
                [(f.subject, f.mark, f.value, f.limit) for f in self.findings],
                0,
            ),
            *(f"  → {f.subject}: {f.advice}" for f in self.findings if f.verdict != "ok" and f.advice),
        ]
        if self.link is not None and self.link.counts.sum():
            lines += ["", _histogram(self.link)]
        return [*lines, "", self.verdict]

    def __str__(self) -> str:
        return text_of(self.pieces())

    def to_dict(self) -> dict[str, Any]:
        """Plain content for JSON."""
        content: dict[str, Any] = {
            "ready": self.exit_code == 0,
            "exit_code": self.exit_code,
            "verdict": self.verdict,
            "findings": [finding.to_dict() for finding in self.findings],
        }
        if self.link is not None:
            content["link"] = {
                "seconds": self.link.seconds,
                "packets": self.link.packets,
                "rate_hz": self.link.rate_hz,
                "period_s": self.link.end.period_s,
                "answered_in_time": self.link.in_time,
                "latency_s": {
                    f"p{100 * q:g}": value if np.isfinite(value) else None
                    for q, value in _quantiles(self.link).items()
                },
                "histogram": {
                    "upper_edges_s": self.link.edges[self.link.counts > 0].tolist(),
                    "counts": self.link.counts[self.link.counts > 0].tolist(),
                },
            }
        return content


def examine(
    patient: Patient,
    *,
    link_s: float | None = None,
    wait_s: float = 20.0,
    report: Callable[[str, float, str], None] | None = None,
) -> Examination:
    """Examine the computer and, for `link_s` seconds, the link.

    wait_s : longest wait for the first packet. report : called with heading, share done and detail.
    """
    findings = examine_computer(patient.address, patient.port, patient.folder, realtime=patient.realtime)
    if link_s is None or any(f.verdict == "fail" and f.subject in ("interface", "port") for f in findings):
        return Examination(tuple(findings))
    tell = report or (lambda heading, share, detail: None)
    interface = find_interface(patient.address)
    before = interface.received if interface else 0

    def waiting(seconds: float, heard: Heard) -> None:
        advice = "Start the KRL program at the pendant"
        tell("waiting for the controller", seconds / wait_s, f"{seconds:.0f} s; heard: {heard}. {advice}")

    heard = listen(patient.address, patient.port, patient.controller, wait_s, waiting)
    traffic = (interface.received if interface else 0) - before
    findings += judge_heard(patient, heard, traffic)
    if findings[-1].verdict == "fail":
        return Examination(tuple(findings))

    def testing(seconds: float, state: LinkState) -> None:
        tell("testing the link", seconds / link_s, f"{state.state} {state.quality}, {state.late} late")

    said = {key: getattr(patient, key) for key in ("address", "port", "controller", "handshake")}
    settings = LinkSettings(**said, realtime="allow")
    with Driver(patient.arm, settings) as driver:
        try:
            driver.connect(timeout_s=wait_s)
        except LwrError as error:
            findings.append(ComputerFinding("packets", "stopped", "go on", "fail", str(error), type(error)))
            return Examination(tuple(findings))
        link = exercise(driver, link_s, counter_int=patient.counter_int, report=testing)
    return Examination((*findings, *judge_link(patient, link)), link)


def judge_heard(patient: Patient, heard: Heard, traffic: int) -> list[ComputerFinding]:
    """The datagrams at the port. traffic : packets received by the interface meanwhile, for any port."""
    place = f"UDP {patient.address}:{patient.port}"
    wanted = f"{MSR_SIZE} bytes, id 0x{MSR_ID:04x}"
    if not heard.kinds:
        seen = f"none on {place} in {heard.waited_s:.1f} s"
        return [
            ComputerFinding("packets", seen, wanted, "fail", _start_advice(patient, traffic), NetworkError)
        ]
    value, advice = f"FRI from {', '.join(heard.fri)}", ""
    if not heard.fri:
        value = str(heard)
        advice = (
            "the sender does not speak FRI 1.0 of a KR C2 lr (an LBR iiwa has another protocol); check the "
            "controller's software, and for other programs at the port"
        )
    elif patient.controller is not None and patient.controller not in heard.fri:
        wanted = f"from {patient.controller}"
        advice = f"set `link.controller` to {heard.fri[0]}, or stop that sender"
    elif patient.controller is None and len(heard.fri) > 1:
        wanted, advice = "one", "name the controller in `link.controller`"
    else:
        value = f"{wanted} from {heard.fri[0]}"
    return [graded("packets", value, wanted, (bool(advice), advice))]


def _start_advice(patient: Patient, traffic: int) -> str:
    steps = (
        f"At the pendant: select and start the KRL program (`{patient.handshake}`); in T1 hold an "
        "enabling switch and the start key until friOpen is passed. In it, or in dlrrc.ini, the host must be "
        f"{patient.address} and the port {patient.port}."
    )
    received = "nothing at all meanwhile: check cable and FRI network card"
    if traffic:
        received = (
            f"{traffic} other packets meanwhile: check host and port on the controller, and the firewall (sudo "
            f"ufw allow {patient.port}/udp)"
        )
    return f"{steps} The interface has received {received}"


def judge_link(patient: Patient, link: LinkTest) -> list[ComputerFinding]:
    """The test of the link, item by item."""
    if link.trouble is not None and not link.packets:
        return [ComputerFinding("packets", "stopped", "go on", "fail", str(link.trouble), NetworkError)]
    return [
        _rate(link),
        _losses(link),
        _replies(link),
        _in_time(link),
        _quality(link),
        *_round_trip(link),
        *_robot(link.end),
        *_program(patient, link),
    ]


def _rate(link: LinkTest) -> ComputerFinding:
    expected = 1.0 / link.end.period_s
    value = f"{link.rate_hz:.1f} packets/s at a cycle of {1000 * link.end.period_s:g} ms"
    off = abs(link.rate_hz - expected) > 0.05 * expected
    advice = "packets are lost, or the controller does not keep its cycle; check cable and network card"
    return graded("rate", value, f"{expected:.1f} ± 5 %", (off, advice))


def _losses(link: LinkTest) -> ComputerFinding:
    names = ("lost", "repeated", "reordered", "malformed", "foreign")
    counts = {name: link.between(name) for name in names}
    value = ", ".join(f"{count} {name}" for name, count in counts.items() if count) or "none"
    bad = counts["lost"] > (1.0 - _GOOD_SHARE) * link.packets or counts["malformed"] > 0
    change = "change the cable, use a network card of its own and no switch in between"
    advice = "one cable, no switch, nothing else on the card"
    return graded("losses", value, "none lost or damaged", (bad, change), (any(counts.values()), advice))


def _quantiles(link: LinkTest) -> dict[float, float]:
    """Quantiles of the reply latency and its maximum (key 1.0) [s], infinite beyond the histogram; empty
    without answers.
    """
    total = int(link.counts.sum())
    if total == 0:
        return {}
    cumulated = np.cumsum(link.counts)
    places = [int(np.searchsorted(cumulated, max(1.0, np.ceil(q * total)))) for q in (*_QUANTILES, 1.0)]
    ends = np.append(link.edges[:-1], np.inf)
    return {q: float(ends[place]) for q, place in zip((*_QUANTILES, 1.0), places, strict=True)}


def _replies(link: LinkTest) -> ComputerFinding:
    found = _quantiles(link)
    half = 0.5 * link.end.period_s
    if not found:
        return ComputerFinding(
            "reply", "no answer left", "each packet", "fail", "see the losses", NetworkError
        )
    words = {q: "over 2000" if np.isinf(value) else f"{1e6 * value:.0f}" for q, value in found.items()}
    shown = ", ".join(f"p{100 * q:g} {words[q]}" for q in _QUANTILES) + f", longest {words[1.0]} µs"
    limit = f"p99 below {1e6 * half:.0f} µs"
    advice = "close other programs, see the real-time rights and the kernel, or choose a longer cycle"
    unknown = bool(np.isinf(found[0.99])) and half > float(link.edges[-1])
    slow = found[0.99] > half
    return graded("reply", shown, limit, (slow and not unknown, advice), (slow, advice))


def _in_time(link: LinkTest) -> ComputerFinding:
    value = f"{100 * link.in_time:.3f} % of {link.packets} cycles"
    poor = "this set-up is not sufficient for command mode; see reply and losses"
    weak = "command mode would be lost now and then; take a longer cycle or a real-time kernel"
    limit = f"{100 * _GOOD_SHARE:g} %"
    share = link.in_time
    return graded("answered in time", value, limit, (share < _POOR_SHARE, poor), (share < _GOOD_SHARE, weak))


def _round_trip(link: LinkTest) -> list[ComputerFinding]:
    """The way there and back by the controller's own clock, if it measures one: stale answers are late by it."""
    end = link.end
    if not end.controller_latency_s > 0.0:
        return []
    cycle = 1000.0 * end.period_s
    value = f"latency {1000 * end.controller_latency_s:.2f} ms, jitter {1000 * end.jitter_s:.2f} ms"
    stale = (
        "the controller gets answers to old packets: stop the KRL program and start it again after the PC; see reply, "
        "and take away switches on the way"
    )
    slow = "the answers come late in the cycle; see reply, or take a longer cycle"
    slower = max(end.controller_latency_s, end.jitter_s) > 0.5 * end.period_s
    cases = (end.controller_latency_s > end.period_s, stale), (slower, slow)
    return [graded("round trip", value, f"below {0.5 * cycle:g} ms, at most {cycle:g} ms", *cases)]


def _quality(link: LinkTest) -> ComputerFinding:
    end = link.end
    value = (
        f"{end.quality}, worst {link.worst_quality}, answer rate {end.answer_rate:.3f}, latency "
        f"{1000 * end.controller_latency_s:.2f} ms, jitter {1000 * end.jitter_s:.2f} ms"
    )
    bad, dips = (_RANKS.index(name) < _RANKS.index("OK") for name in (end.quality, link.worst_quality))
    limit = "OK throughout" if dips and not bad else "OK"
    advice = "command mode needs it without interruption; see reply and losses"
    return graded("quality", value, limit, (bad, advise_quality(end) if bad else ""), (dips, advice))


def _robot(state: LinkState) -> list[ComputerFinding]:
    stiff = state.control != "POSITION"
    strategy = "$STIFFNESS.STRATEGY=10; the KRL programs do so when command mode is asked for"
    bits = f"power 0x{state.power:02x}, error 0x{state.error:02x}, warning 0x{state.warning:02x}"
    error = (state.error != 0, "acknowledge the messages at the pendant")
    off = (state.power != ALL_DRIVES, "switch the drives on before a motion")
    hottest = float(np.max(state.temperature))
    shown = f"at most {hottest:.0f} °C"
    warm = "friction changes with temperature; let the arm rest, or warm it up to the same point each time"
    value, limit = f"{state.state}, control {state.control}", "POSITION" if stiff else "MON"
    return [
        graded("state", value, limit, shortcoming=(stiff, strategy)),
        graded("drives", bits, "no error" if state.error else "0x7f to move", error, off, RobotError),
        ComputerFinding("temperature", shown, f"{_WARM:.0f} °C", "advice" if hottest > _WARM else "ok", warm),
    ]


def _program(patient: Patient, link: LinkTest) -> list[ComputerFinding]:
    """The KRL program: its name, its load data, its motor torques."""
    handshake = find_handshake(patient.handshake)
    opened = handshake.opened(link.msr)
    integers = np.trim_zeros(link.msr["krl_int"], "b").tolist()
    value = f"{handshake.name} takes requests" if opened else f"$FRI_TO_INT = {integers}"
    other = (
        "another program runs, or it waits at a message: look at the pendant, and set `link.handshake` "
        "to the program"
    )
    found = [graded("KRL program", value, handshake.name, (not opened, other), who=RobotError)]
    if opened and isinstance(handshake, IdentificationHandshake):
        mass, *centre = handshake.load(link.msr).tolist()
        place = ", ".join(f"{value:.0f}" for value in centre)
        text = f"{mass:.3f} kg at ({place}) mm from the flange" if mass else "none: the empty flange"
        found.append(ComputerFinding("load data", text, "as mounted", "ok"))
    if link.fresh is None:
        return found
    rate = link.fresh / link.seconds if link.seconds > 0.0 else 0.0
    silent = (
        "the KRL program does not count them; check `motor_torque.krl.counter_int`, or set "
        "`motor_torque.source` to none (Model 1)"
    )
    slow = "they will bound the bandwidth of Models 2 and 3; shorten the loop of the KRL program"
    cases = ((link.fresh <= 0, silent), (rate < 20.0, slow))
    return [*found, graded("motor torques", f"{rate:.1f} new values/s", "above 20/s", *cases, RobotError)]


def _histogram(link: LinkTest) -> Listing:
    edges = np.array([*_STEPS, np.inf])
    places = np.searchsorted(edges, 1e6 * link.edges - 1e-6)
    places[-1] = len(edges) - 1
    sums = np.bincount(places, weights=link.counts, minlength=len(edges))
    total = sums.sum()
    rows = []
    for place, count in enumerate(sums.tolist()):
        name = f"to {edges[place]:.0f} µs" if np.isfinite(edges[place]) else f"over {_STEPS[-1]:.0f} µs"
        bar = "█" * round(_BAR * count / total)
        rows.append((name, f"{int(count)}", f"{100 * count / total:.3f}", bar))
    return Listing(("packet to answer", "count", "%", ""), rows)
