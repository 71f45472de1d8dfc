"""The live view: a page with the arm, its torques, the link and the progress, from its own process.

The process reads the loop's ring without taking rows from the recorder, so neither is disturbed. It ends with its
parent process.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import queue
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from fri import interpreter
from fri.errors import ConfigurationError, LwrError
from fri.states import Quality, State
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell, PayloadShape
from lwr_driver.motion import Motion
from lwr_driver.ring import Ring
from runner.experiment_file import Experiment, Payload

Floats = NDArray[np.float64]

_RATE_HZ = 20.0
_TEXT_EVERY = 5
_HISTORY_S = 20.0
_NICE = 10
_START_S = 60.0
_STOP_S = 5.0
_MOST_ROWS = 1024
_COLOURS = ("#000000", "#e69f00", "#56b4e9", "#009e73", "#0072b2", "#d55e00", "#cc79a7")


class LiveView:
    """Handle of the live view's process; a context manager. url : address of the page.

    ring_name : of the driver (`Driver.ring_name`). ConfigurationError without the extra `view`.
    """

    def __init__(self, experiment: Experiment, ring_name: str, *, port: int = 8080) -> None:
        if importlib.util.find_spec("viser") is None:
            from runner.report.interactive import INSTALL

            raise ConfigurationError(f"--live: {INSTALL}")
        # Opened here: other processes of this user may not be allowed to look into this one.
        with Ring.attach(ring_name) as ring:
            self._process = self._start(experiment, ring, port)
        self.url = self._first_line()

    def _start(self, experiment: Experiment, ring: Ring, port: int) -> subprocess.Popen[str]:
        settings = {
            "ring": ring.inherited,
            "port": port,
            "arm": experiment.arm,
            "cell": experiment.cell,
            "beside": str(experiment.folder),
        }
        return subprocess.Popen(
            interpreter.command("-m", "runner.live", json.dumps(settings)),
            pass_fds=(ring.descriptor,),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=interpreter.environment(),
            start_new_session=True,
        )

    def begin(self, session: str, payload: Payload | None, motion: Motion) -> None:
        """Announce a session's motion: payload, phases and duration."""
        self._send(
            {
                "session": session,
                "payload": None if payload is None else asdict(payload),
                "rows": len(motion),
                "period_s": motion.period_s,
                "phases": [[int(row), name] for row, name in motion.phases],
            }
        )

    def close(self) -> None:
        """End the page. Safe to call twice."""
        if self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
        try:
            self._process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()

    def __enter__(self) -> LiveView:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _send(self, message: Mapping[str, Any]) -> None:
        # A dead page must not stop a moving arm.
        if self._process.stdin is not None:
            with contextlib.suppress(OSError, ValueError):
                self._process.stdin.write(json.dumps(message) + "\n")
                self._process.stdin.flush()

    def _first_line(self) -> str:
        lines: queue.Queue[str] = queue.Queue()
        stream = self._process.stdout
        assert stream is not None
        threading.Thread(target=lambda: lines.put(stream.readline()), daemon=True).start()
        try:
            said = json.loads(lines.get(timeout=_START_S))
        except (queue.Empty, ValueError):
            said = {}
        if "url" not in said:
            self.close()
            reason = said.get("error", "the live view did not start")
            raise ConfigurationError(f"--live: {reason}; leave out --live, or choose another --live-port")
        return str(said["url"])


class Sample:
    """Content of the page from the newest cycles. rows : of the ring, newest last, (n,) of `ROW`, n > 0."""

    def __init__(self, rows: NDArray[Any]) -> None:
        row = rows[-1]
        msr = row["msr"]
        self.time_s = int(row["sequence"]) * float(msr["msr_sample_time"])
        self.row = int(row["plan_index"])
        self.state = State(int(msr["state"])).name
        self.quality = Quality(int(msr["quality"])).name
        self.q = np.array(msr["msr_jnt_pos"], dtype=np.float64)
        self.torque = np.array(msr["msr_jnt_trq"], dtype=np.float64)
        answered = rows["answered"] == 1
        setpoint = rows["msr"]["cmd_jnt_pos"].astype(np.float64) + rows["msr"]["cmd_jnt_pos_fri_offset"]
        commanded = np.where(answered[:, None], rows["cmd"]["jnt_pos"].astype(np.float64), setpoint)
        self.commanded = commanded[-1]
        gap = rows["msr"]["msr_jnt_pos"].astype(np.float64) - commanded
        # The worst of all cycles since the last update, to show every spike.
        self.error = gap[np.argmax(np.abs(gap), axis=0), np.arange(gap.shape[1])]
        self.answer_rate = float(msr["answer_rate"])
        self.latency_s, self.jitter_s = float(msr["latency"]), float(msr["jitter"])
        self.missed = int(msr["miss_counter"])
        self.lost = int(np.maximum(np.diff(rows["sequence"]) - 1, 0).sum())


class Dashboard:
    """The page. `announce` takes a session, `show` the newest sample."""

    def __init__(self, server: Any, arm: Arm, cell: Cell) -> None:
        from runner.scene import GHOST, ArmShape, add_cell

        self._server, self._arm = server, arm
        self._shape, self._ghost = ArmShape, GHOST
        add_cell(server.scene, cell)
        self._session: Mapping[str, Any] = {}
        self._history: deque[tuple[float, Floats, Floats]] = deque()
        self._count = 0
        self._lost = 0
        self._build_arms(None)
        gui = server.gui
        gui.configure_theme(control_width="large", show_share_button=False)
        self._title = gui.add_markdown("## waiting for the motion")
        self._bar = gui.add_progress_bar(0.0)
        self._link = gui.add_markdown("")
        self._table = gui.add_markdown("")
        empty = tuple(np.zeros(1) for _ in range(len(arm.joint_names) + 1))
        coloured = zip(arm.joint_names, _COLOURS, strict=False)
        lines = ({"label": name, "stroke": colour, "width": 1.5} for name, colour in coloured)
        series = ({"label": "t"}, *lines)
        axes, scales = ({"label": "time [s]"}, {"size": 56}), {"x": {"time": False}}
        self._errors, self._torques = (
            gui.add_uplot(empty, series, title=title, axes=axes, scales=scales, height=230)
            for title in ("tracking error [mrad]", "joint torque, % of its limit")
        )

    def announce(self, session: Mapping[str, Any]) -> None:
        """A session begins: its name, payload, rows, period and phases."""
        self._session = session
        self._history.clear()
        self._lost = 0
        self._build_arms(_payload(session.get("payload")))

    def show(self, sample: Sample) -> None:
        """Bring the page up to date."""
        self._measured.pose(sample.q)
        self._commanded.pose(sample.commanded)
        self._lost += sample.lost
        self._history.append(
            (sample.time_s, 1000.0 * sample.error, 100.0 * sample.torque / self._arm.tau_max)
        )
        while self._history and self._history[0][0] < sample.time_s - _HISTORY_S:
            self._history.popleft()
        self._count += 1
        if self._count % _TEXT_EVERY == 1:
            self._texts(sample)
            self._plots(sample.time_s)

    def _texts(self, sample: Sample) -> None:
        rows, period = int(self._session.get("rows", 0)), float(self._session.get("period_s", 0.0))
        if sample.row >= 0 and rows > 1:
            done, total = sample.row * period, (rows - 1) * period
            self._bar.value = 100.0 * sample.row / (rows - 1)
            text = f"{self._session['session']}: {phase_at(self._session.get('phases', []), sample.row)}"
            self._title.content = f"## {text}\n{done:.1f} of {total:.1f} s, **{total - done:.1f} s left**"
        else:
            self._title.content = f"## {self._session.get('session', 'waiting')}\nno motion now"
        self._link.content = (
            f"**{sample.state}**, quality **{sample.quality}**, answer rate {100 * sample.answer_rate:.1f} %, "
            f"latency {1e3 * sample.latency_s:.2f} ms, jitter {1e3 * sample.jitter_s:.2f} ms, "
            f"**{sample.missed}** missed, **{self._lost}** lost"
        )
        lines = ["| | measured ° | commanded ° | error mrad | torque Nm |", "|:--|--:|--:|--:|--:|"]
        measured, commanded = np.degrees(sample.q), np.degrees(sample.commanded)
        errors = 1000.0 * sample.error
        columns = zip(self._arm.joint_names, measured, commanded, errors, sample.torque, strict=True)
        lines += [f"| {n} | {q:.2f} | {c:.2f} | {e:+.1f} | {tau:.1f} |" for n, q, c, e, tau in columns]
        self._table.content = "\n".join(lines)

    def _plots(self, now: float) -> None:
        time_s = np.array([entry[0] for entry in self._history]) - now
        if len(time_s) < 2:
            return
        for plot, place in ((self._errors, 1), (self._torques, 2)):
            columns = np.array([entry[place] for entry in self._history])
            plot.data = (time_s, *(np.ascontiguousarray(column) for column in columns.T))

    def _build_arms(self, payload: Payload | None) -> None:
        scene = self._server.scene
        self._measured = self._shape(scene, self._arm, "/measured", payload=payload)
        self._commanded = self._shape(
            scene, self._arm, "/commanded", payload=payload, colour=self._ghost, opacity=0.3
        )


def phase_at(phases: Iterable[Sequence[Any]], row: int) -> str:
    """Name of the phase at a row of a motion. phases : first row and name of each, in order."""
    names = [str(name) for first, name in phases if first <= row]
    return names[-1].replace("_", " ") if names else ""


def _payload(content: Any) -> Payload | None:
    if content is None:
        return None
    shape = content.pop("shape", None)
    return Payload(**content, shape=None if shape is None else PayloadShape(**shape))


def main(arguments: list[str], commands: IO[str], answers: IO[str]) -> None:
    """The process: serve the page, read the ring, until `commands` ends.

    arguments : one JSON text with `ring`, `port`, `arm`, `cell`, `beside`. commands : one announced session a
    line. answers : gets the address of the page.
    """
    settings = json.loads(arguments[0])
    with contextlib.suppress(OSError):
        os.nice(_NICE)
    from runner.scene import start_server, stop_server

    beside = Path(settings["beside"])
    try:
        arm, cell = Arm.load(settings["arm"], beside=beside), Cell.load(settings["cell"], beside=beside)
        server = start_server(int(settings["port"]))
    except (LwrError, OSError) as error:
        print(json.dumps({"error": str(error)}), file=answers, flush=True)
        return
    page = Dashboard(server, arm, cell)
    announced: queue.Queue[str | None] = queue.Queue()
    threading.Thread(target=lambda: _read(commands, announced), daemon=True).start()
    url = f"http://127.0.0.1:{server.get_port()}"
    print(json.dumps({"url": url}), file=answers, flush=True)
    seen = 0
    try:
        with Ring.attach(settings["ring"]) as ring:
            while True:
                with contextlib.suppress(queue.Empty):
                    line = announced.get(timeout=1.0 / _RATE_HZ)
                    if line is None:
                        return
                    page.announce(json.loads(line))
                head = ring.head
                if head > seen:
                    rows = ring.peek(min(head - seen, _MOST_ROWS))
                    if len(rows):
                        page.show(Sample(rows))
                    seen = head
    finally:
        stop_server(server)


def _read(stream: IO[str], lines: queue.Queue[str | None]) -> None:
    for line in stream:
        lines.put(line)
    lines.put(None)


if __name__ == "__main__":
    main(sys.argv[1:], sys.stdin, sys.stdout)
