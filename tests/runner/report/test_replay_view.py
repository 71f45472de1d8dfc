"""A session beside its simulation: what a browser and a video show of it."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image
from playwright.sync_api import Browser

from fri.errors import ConfigurationError
from ident.diagnosis.healthy.reference import Reference
from ident.model.model_file import read_model, write_model
from runner.cli import main
from runner.encoder import encoder_of
from runner.replay_video import frames, write_video
from runner.replay_view import MotionReplay, error_colour, motion_replay
from runner.report.folder import ResultFolder
from tests.runner.report.view_rig import CLIPPED, NARROW, WIDE, flaws, opened

pytestmark = pytest.mark.slow

WRONG_JOINT = 3
DRAWN = """() => [...document.querySelectorAll('.uplot canvas')].map((canvas) => {
  const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
  let count = 0;
  for (let k = 0; k < data.length; k += 4) count += data[k] > 180 && data[k + 2] < 60 && data[k + 3] > 100;
  return count;
})[0]"""
"""Pixels of the line of the base model in the plot of the torque error."""


@pytest.fixture(scope="module")
def heavier(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model with too much Coulomb friction in one joint."""
    model = read_model(finished / "model.yaml")
    values = model.values.copy()
    values[model.names.index(f"Fcl{WRONG_JOINT + 1}")] += 2.0
    path = tmp_path_factory.mktemp("heavier") / "heavier.yaml"
    write_model(replace(model, values=values), path)
    return path


@pytest.fixture(scope="module")
def shown(finished: Path, heavier: Path) -> MotionReplay:
    """The wrong model as the base, the identified one as the extended."""
    return motion_replay(finished, model=heavier, extended=finished / "model.yaml", longest_s=4.0)


def test_the_held_out_session_is_replayed_and_the_wrong_joint_is_told(shown: MotionReplay) -> None:
    assert shown.session == "check"
    assert shown.payload is not None
    assert shown.payload.mass == 3.34
    assert shown.told_joint == WRONG_JOINT
    base, extended = shown.rms("base")[1], shown.rms("extended")[1]
    assert base[WRONG_JOINT] > 4.0 * extended[WRONG_JOINT]
    np.testing.assert_allclose(np.delete(base, WRONG_JOINT), np.delete(extended, WRONG_JOINT), rtol=0.5)


def test_the_ghost_deviates_as_measured_minus_simulated_says_enlarged(shown: MotionReplay) -> None:
    error = shown.runs["extended"].position
    assert error is not None
    ghost = shown.simulated("extended", 50.0)
    assert ghost is not None
    np.testing.assert_allclose(ghost, shown.measured - 50.0 * error)
    largest = max(np.abs(run.position).max() for run in shown.runs.values() if run.position is not None)
    assert 0.04 < shown.enlarged * largest <= 0.12


def test_the_part_shown_is_that_of_the_log(shown: MotionReplay, finished: Path) -> None:
    log = motion_replay(finished / "check.mcap", longest_s=4.0)
    assert list(log.runs) == ["base"]
    np.testing.assert_array_equal(log.time, shown.time)
    np.testing.assert_array_equal(log.measured, shown.measured)
    assert np.diff(shown.time) == pytest.approx(0.02)


def test_the_encoders_are_simulated_where_the_arm_has_them(finished: Path, tmp_path: Path) -> None:
    model = read_model(finished / "model.yaml")
    log = ResultFolder.load(finished).sessions["check"]
    text = log.attachments["experiment.yaml"].decode()
    assert encoder_of(log, finished, [model]) == "link"
    assert encoder_of(log, tmp_path, [model]) == "link"
    moved = text.replace("emulator_settings: {", "emulator_settings: {sensors.position_sensor: motor, ")
    emulated = replace(log, attachments={"experiment.yaml": moved.encode()})
    assert encoder_of(emulated, tmp_path, [model]) == "motor"
    real = replace(
        log,
        attachments={
            "experiment.yaml": text.replace("name:", "backend: fri\nlock_step: false\nname:").encode()
        },
    )
    assert encoder_of(real, tmp_path, [model]) is None
    n = len(model.structure.chain.joint_names)
    healthy = Reference(
        model,
        compliance=np.full(n, 1e-4),
        motor_delay_s=0.0,
        joint_delay_s=0.0,
        noise={},
        null={},
        sets=3,
        encoder="motor",
    )
    commissioned = replace(model, provenance={**model.provenance, **healthy.stored()})
    assert encoder_of(real, tmp_path, [commissioned]) == "motor"
    gap = {
        "gap": {"value": 1e-3, "std": 1e-4, "unit": "rad"},
        "width": {"value": 1.0, "std": 0.1, "unit": "Nm"},
    }
    effect = {"cause": "backlash", "joints": [3], "form": "encoder at the motor", "parameters": gap}
    found = replace(model, effects=(effect,))
    assert encoder_of(real, tmp_path, [model, found]) == "motor"


def test_a_log_that_does_not_tell_the_place_of_the_encoders_says_so(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    linked = motion_replay(finished, longest_s=2.0)
    assert linked.facts()["encoder"] == "link"
    assert not any("encoders" in note for note in linked.notes)
    monkeypatch.setattr("runner.replay_view.encoder_of", lambda *_: None)
    unknown = motion_replay(finished, longest_s=2.0)
    assert [note for note in unknown.notes if "encoders" in note] == [
        "nothing tells where this arm has its encoders; they are simulated at the links"
    ]
    monkeypatch.setattr("runner.replay_view.encoder_of", lambda *_: "motor")
    turned = motion_replay(finished, longest_s=2.0)
    before, after = linked.runs["base"].position, turned.runs["base"].position
    assert before is not None
    assert after is not None
    assert turned.facts()["encoder"] == "motor"
    assert np.abs(after - before).max() > 1e-4


@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
def test_a_video_has_frames_that_differ(shown: MotionReplay, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"replay{suffix}"
    write_video(shown, path, length_s=1.0)
    assert [one.name for one in tmp_path.iterdir()] == [path.name]
    pictures = read_frames(path)
    assert len(pictures) >= 10
    for before, after in ((0, 1), (0, len(pictures) // 2), (0, -1)):
        assert (np.abs(pictures[before] - pictures[after]).max(axis=2) > 60).sum() > 50


def read_frames(path: Path) -> list[np.ndarray]:
    if path.suffix == ".gif":
        with Image.open(path) as film:
            found = []
            for number in range(film.n_frames):
                film.seek(number)
                found.append(np.asarray(film.convert("RGB")).astype(int))
            return found
    import imageio_ffmpeg

    read = imageio_ffmpeg.read_frames(str(path))
    width, height = next(read)["size"]
    return [np.frombuffer(one, np.uint8).reshape(height, width, 3).astype(int) for one in read]


def test_both_arms_are_drawn_for_each_model(shown: MotionReplay) -> None:
    green, solid = np.zeros(2), np.zeros(2)
    for picture in frames(shown, 5, 1.0):
        height, width, _ = picture.shape
        scenes = picture[int(0.17 * height) : int(0.72 * height)].astype(int)
        for place, half in enumerate((scenes[:, : width // 2], scenes[:, width // 2 :])):
            r, g, b = half.reshape(-1, 3).T
            green[place] += (((g - r) > 25) & ((g - b) > 5)).sum()
            solid[place] += ((r >= b - 20) & (r < 240)).sum()
    assert green.min() > 200
    assert solid.min() > 10_000


def test_a_link_turns_red_with_its_error() -> None:
    shades = [error_colour(share) for share in (0.0, 0.5, 1.0, 3.0)]
    assert shades[2] == shades[3]
    assert np.all(np.diff([red - blue for red, _, blue in shades[:3]]) > 0)


def test_a_browser_scrubs_through_the_replay(finished: Path, heavier: Path, chrome: Browser) -> None:
    command = [sys.executable, "-m", "runner.cli", "replay", str(finished), "--model", str(heavier)]
    command += ["--extended", str(finished / "model.yaml"), "--longest-s", "4", "--port", "18231"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        address = process.stdout.readline().strip()
        try:
            assert address == "http://127.0.0.1:18231"
            with opened(chrome, address, (WIDE[0], 360)) as seen:
                page = seen.page
                page.get_by_label("play").uncheck(timeout=120_000)
                time_s = page.locator("input[inputmode=decimal], input[type=number]").first
                begin, end = float(page.get_by_role("slider").get_attribute("aria-valuemin")), 0.0
                for wanted in (begin + 1.0, begin + 2.0):
                    time_s.fill(f"{wanted:.2f}")
                    time_s.press("Enter")
                    page.wait_for_function(
                        "t => { const m = document.body.innerText.match(/t = ([0-9.]+) s/);"
                        " return m && Math.abs(parseFloat(m[1]) - t) < 0.03; }",
                        arg=wanted,
                        timeout=120_000,
                    )
                    errors, end = torque_errors(page.inner_text("body")), wanted
                page.wait_for_timeout(700)
                text = page.inner_text("body")
                assert float(re.findall(r"t = ([\d.]+) s", text)[0]) == pytest.approx(end, abs=0.03)
                page.locator("input[value='base model']").first.click()
                page.get_by_role("option", name="extended model").click()
                page.get_by_text("s, extended model").wait_for(timeout=120_000)
                page.wait_for_timeout(500)
                extended = torque_errors(page.inner_text("body"))
                assert page.evaluate(DRAWN) > 100
                for width in (WIDE[0], NARROW[0]):
                    page.set_viewport_size({"width": width, "height": 360})
                    page.wait_for_timeout(500)
                    slider = page.get_by_role("slider", name="time [s]")
                    slider.wait_for(timeout=120_000)
                    assert slider.count() == 1
                    assert flaws(seen) == []
                    assert page.evaluate(CLIPPED) == []
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 0
        finally:
            process.kill()
    assert end == begin + 2.0
    assert "Replay of check" in text
    assert abs(errors["A3"]) > 1.0 > abs(extended["A3"])


def torque_errors(text: str) -> dict[str, float]:
    rows = re.findall(r"^(A\d|E\d)\s+[+-][\d.]+\s+([+-][\d.]+)$", text, re.MULTILINE)
    return {name: float(error) for name, error in rows}


def test_the_command_writes_a_video_and_its_numbers(finished: Path, tmp_path: Path) -> None:
    target = tmp_path / "check.gif"
    line = ["replay", str(finished), "--longest-s", "2", "--length-s", "0.5", "--out", str(target), "--json"]
    done = CliRunner().invoke(main, line)
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert found["place"] == str(target)
    assert found["session"] == "check"
    assert len(found["rms"]["base"]["torque_nm"]) == 7
    assert target.stat().st_size > 10_000


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("check.avi", r"'.avi' is no format of a video; end the name in .mp4 or .gif"),
        ("check", "'none' is no"),
    ],
)
def test_a_wrong_suffix_is_refused_before_the_simulation(tmp_path: Path, name: str, message: str) -> None:
    done = CliRunner().invoke(main, ["replay", str(tmp_path), "--out", str(tmp_path / name)])
    assert done.exit_code == 2
    assert message in done.output


def test_what_is_missing_is_told_with_the_remedy(finished: Path, tmp_path: Path) -> None:
    alone = tmp_path / "check.mcap"
    alone.symlink_to(finished / "check.mcap")
    with pytest.raises(ConfigurationError, match=r"no model beside the log .* name one with --model"):
        motion_replay(alone)
    with pytest.raises(ConfigurationError, match="no readable log of session 'heavy'; there are: unloaded"):
        motion_replay(finished, session="heavy")
    with pytest.raises(ConfigurationError, match=r"no extended model .* --extended"):
        motion_replay(finished, extended=tmp_path / "none.yaml")


def test_without_ffmpeg_the_advice_is_to_install_it_or_take_a_gif(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    done = CliRunner().invoke(main, ["replay", str(tmp_path), "--out", str(tmp_path / "a.mp4")])
    assert done.exit_code == 2
    assert "lwr-identification[view]" in done.output
    assert ".gif" in done.output
