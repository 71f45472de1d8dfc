"""What a terminal shows: every screen of an experiment, at widths from 40 columns."""

from __future__ import annotations

import codecs
import fcntl
import io
import logging
import os
import pty
import re
import struct
import subprocess
import sys
import termios
import time
from dataclasses import dataclass, field
from pathlib import Path

import pyte
import pytest

from runner import status
from runner.cli import _Screen
from runner.status import StatusLine
from tests.runner.experiment.experiment_rig import experiment_file

LWR_RUN = str(Path(sys.executable).parent / "lwr-run")
WIDTHS = (40, *(pytest.param(width, marks=pytest.mark.long) for width in (80, 200)))
HEIGHT = 200
PLAIN = {"NO_COLOR": "", "CI": "", "COLUMNS": "", "LINES": ""}


class Screen(pyte.Screen):
    """A terminal that notes each line broken by its right margin."""

    def __init__(self, columns: int) -> None:
        self.broken: list[str] = []
        super().__init__(columns, HEIGHT)

    def draw(self, data: str) -> None:
        """Draw `data`, character by character, as a terminal with automatic margins."""
        for character in data:
            if self.cursor.x == self.columns:
                self.broken.append(self.display[self.cursor.y] + character)
            super().draw(character)


@dataclass
class Seen:
    """The screens of a command. frames : the text after each piece of output."""

    screen: Screen
    frames: list[list[str]] = field(default_factory=list)
    code: int = -1

    @property
    def text(self) -> list[str]:
        return [line.rstrip() for line in self.screen.display if line.strip()]

    def lines(self) -> set[str]:
        return {line for frame in self.frames for line in frame}


def watch(columns: int, command: list[str], place: Path, **environment: str) -> Seen:
    """Run a command at a terminal of that width, to its end."""
    leader, follower = pty.openpty()
    fcntl.ioctl(follower, termios.TIOCSWINSZ, struct.pack("HHHH", HEIGHT, columns, 0, 0))
    variables = {key: value for key, value in {**os.environ, **PLAIN, **environment}.items() if value}
    variables.setdefault("TERM", "xterm-256color")
    process = subprocess.Popen(
        command, cwd=place, env=variables, stdin=follower, stdout=follower, stderr=follower
    )
    os.close(follower)
    seen = Seen(Screen(columns))
    stream, decode = pyte.Stream(seen.screen), codecs.getincrementaldecoder("utf-8")("replace").decode
    while True:
        try:
            data = os.read(leader, 65536)
        except OSError:  # the last process has closed its end
            break
        if not data:
            break
        # A slow reader finds several screens in one piece; each begins by returning the cursor.
        for text in re.split(r"(?=\r\x1b)", decode(data)):
            stream.feed(text)
            seen.frames.append(seen.text)
    os.close(leader)
    seen.code = process.wait()
    return seen


@pytest.fixture(scope="module", params=WIDTHS)
def seen(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Seen:
    """A short experiment at one width."""
    place = tmp_path_factory.mktemp("screens")
    name = experiment_file(place, identification={"model": 1}).name
    return watch(request.param, [LWR_RUN, "experiment", name, "--yes", "--out", "results"], place)


@pytest.mark.slow
def test_no_line_of_an_experiment_is_broken_by_the_margin(seen: Seen) -> None:
    assert seen.code == 0, seen.text
    assert seen.screen.broken == []


@pytest.mark.slow
def test_one_live_line_has_phase_bar_and_time(seen: Seen) -> None:
    live = [line for line in seen.lines() if "━" in line or "─" in line]
    assert any(re.match(r"(un)?loaded: .*[━─]", line) for line in live), live
    assert all(sum("━" in line for line in frame) <= 1 for frame in seen.frames)
    assert any("estimating the model" in line for line in seen.lines())
    # Nothing of it stays.
    assert not any("━" in line or "─" in line for line in seen.text)


@pytest.mark.slow
def test_the_screen_ends_with_verdict_numbers_and_the_next_step(seen: Seen) -> None:
    text = seen.text
    assert text[-1] == "open results/report.html"
    end = "\n".join(text[-30:])
    assert "run" in end
    for number in ("torque error", "parameters", "payload mass"):
        assert number in end
    assert "RSD" not in end  # tables are in report.txt
    assert not seen.screen.cursor.hidden


def test_a_line_fits_every_width() -> None:
    line = status._Line("validation: move to start", 0.4, ("missed 0", "tracking 12.3 mrad", "CMD PERFECT"))
    for width in range(40, 201):
        text = line.text(width).plain
        assert len(text) < width
        assert "validation: m" in text
        assert "━" in text
    assert line.text(40).plain.rstrip().endswith("-:--")
    assert "missed 0" in line.text(120).plain


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("identfy", "did you mean 'identify'?"),
        ("report . --fromat pdf", "Did you mean '--format'?"),
        ("report . --format pgf", "--format is for figures; add --figures FOLDER"),
        ("check experimnt.yaml", "did you mean experiment.yaml?"),
        ("trend", "--store fleet: no such file or folder"),
    ],
)
def test_a_slip_of_the_pen_is_told_within_a_narrow_screen(line: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "experiment.yaml").write_text("name: own\n")
    seen = watch(40, [LWR_RUN, *line.split()], tmp_path)
    assert seen.code == 2
    assert said in " ".join(" ".join(seen.text).split())
    assert seen.screen.broken == []


def test_a_long_path_is_broken_so_that_a_shell_takes_it() -> None:
    path = "experiments/lwr4plus-20260101-120000/report.html"
    for width in (40, 50, 60):
        shown = status._hung(f"open {path}", width, "", True).plain
        assert max(map(len, shown.split("\n"))) <= width
        done = subprocess.run(
            ["bash", "-c", f"printf '%s|' {shown}"], capture_output=True, text=True, check=True
        )
        assert done.stdout == f"open|{path}|"


def test_waiting_says_once_what_is_awaited_and_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    leader, follower = pty.openpty()
    for name in ("CI", "NO_COLOR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "60")
    screen = Screen(60)
    with open(follower, "w", encoding="utf-8") as terminal:
        line = StatusLine(terminal)
        for since in (1.0, 7.0, 62.0):
            line.wait("the first packet", since, "no packet yet, 0 malformed", "Start the KRL program.")
            line._live.refresh()  # type: ignore[union-attr]
        shown = b""
        while not re.search(rb"1:\d\d.*\S", shown):  # a busy terminal hands its text out in pieces
            shown += os.read(leader, 65536)
        pyte.Stream(screen).feed(shown.decode())
        text = [row.rstrip() for row in screen.display if row.strip()]
        line.clear()
    os.close(leader)
    said, counted = text
    assert said == "waiting for the first packet. Start the KRL program."
    assert re.fullmatch(r"waiting for the first packet  1:\d\d  no packet yet", counted)


@pytest.mark.parametrize("variables", [{"TERM": "dumb"}, {"CI": "true"}, {"NO_COLOR": "1"}])
def test_colours_and_cursor_movements_are_left_out_on_request(
    variables: dict[str, str], tmp_path: Path
) -> None:
    codes: list[str] = []
    command = [LWR_RUN, "info", "nothing.mcap"]
    leader, follower = pty.openpty()
    environment = {key: value for key, value in os.environ.items() if key not in PLAIN} | variables
    done = subprocess.run(command, cwd=tmp_path, stdout=follower, stderr=follower, env=environment)
    os.close(follower)
    codes.append(os.read(leader, 65536).decode())
    os.close(leader)
    assert done.returncode == 2
    assert "no such file or folder" in codes[0]
    assert "[31m" not in codes[0]


def test_a_pipe_gets_each_message_once_and_no_control_characters() -> None:
    stream = io.StringIO()
    line = StatusLine(stream)
    for k in range(50):
        line.show("unloaded", k / 50, "tracking 1 mrad", phase=f"period {k // 25}")
    line.say("done")
    line.show("estimating the model")
    line.clear()
    assert stream.getvalue() == "unloaded\ndone\n"


def test_the_time_left_follows_the_pace(monkeypatch: pytest.MonkeyPatch) -> None:
    clock: list[float] = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    line = status._Line("a", 0.0, began=100.0)
    clock[0], line.fraction = 130.0, 0.25
    assert line.left() == "1:30"
    assert status.duration(3723) == "1:02:03"


def test_a_warning_about_data_is_written_once(capsys: pytest.CaptureFixture[str]) -> None:
    screen = _Screen()
    for name in ("ident.estimation.identify", "ident.rows.prepare", "fri.pc", "fri.pc"):
        screen.handle(logging.LogRecord(name, logging.WARNING, "", 0, "%s: jumps", (name[:5],), None))
    assert capsys.readouterr().err.split("\n")[:-1] == ["ident: jumps", "fri.p: jumps", "fri.p: jumps"]
