"""Commands of the first day at an arm: record, hold, jog, home."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fri.errors import ConfigurationError, OperatorError
from runner.output import NEW_FILE, check_folder
from runner.status import StatusLine, answer
from runner.terminal import NAMED_FILE, PATH, FiniteRange, ask, default_file, implied, json_option, tell, verb

if TYPE_CHECKING:
    from runner.experiment_file import Experiment
    from runner.steps import Pose, Step, Steps

_FOLDER = Path("steps")
_SPEED = 0.1
_EMPTY = "none"
_SILENCE_S = 60.0
"""A recording survives so much silence: another KRL program is selected meanwhile."""

out_option = click.option("--out", type=NEW_FILE, help="Session log; default: steps/NAME-STAMP.mcap.")
payload_option = click.option(
    "--payload",
    metavar="NAME",
    help="Mounted payload, of FILE; `none`: the empty flange, the default unless the controller has load data.",
)
yes_option = click.option("--yes", is_flag=True, help="Confirm every question; for automation.")
rights_option = click.option(
    "--allow-non-realtime", is_flag=True, help="Command a real arm without real-time rights; may stutter."
)


def _step_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """The options of every step that commands the arm."""
    for option in (json_option, rights_option, yes_option, out_option, payload_option):
        command = option(command)
    return command


speed_option = click.option(
    "--speed",
    default=_SPEED,
    show_default=True,
    type=FiniteRange(0.0, 0.5, min_open=True),
    help="Share of the velocity limits.",
)


def _no_option(context: click.Context, parameter: click.Parameter, value: str) -> str:
    """Refuse an unknown option taken for an argument, for `jog` takes negative numbers."""
    if value.startswith("-"):
        raise click.NoSuchOption(value, ctx=context)
    return value


@dataclass(frozen=True)
class _Order:
    """What the options of every step say."""

    name: str
    file: str
    out: Path | None
    payload: str | None = None
    question: str = ""
    yes: bool = True
    allow_non_realtime: bool = False
    as_json: bool = False


def _run(order: _Order, work: Callable[[Steps, Path], Step]) -> Step:
    """Connect, do the step, and say what was done."""
    from runner.experiment_file import Experiment
    from runner.laboratory import Laboratory
    from runner.steps import Steps

    path = _log(order)
    experiment = Experiment.commanded(order.file, implied=order.name != "record" and implied())
    payload = _payload(experiment, order.payload)
    status = StatusLine()
    if order.question and experiment.backend == "fri" and not order.yes:
        question = f"{order.question} Keep people away and a hand on the emergency stop. Ready?"
        if not ask(question):
            raise OperatorError(f"{order.name} was not confirmed; nothing moved")
    path.parent.mkdir(parents=True, exist_ok=True)
    laboratory = Laboratory(experiment, allow_non_realtime=order.allow_non_realtime, status=status)
    if order.name == "record":
        laboratory = Laboratory(experiment, allow_non_realtime=True, status=status, silence_s=_SILENCE_S)
    with laboratory as bench:
        return work(Steps(experiment, bench, payload, empty=order.payload == _EMPTY), path)


def _log(order: _Order) -> Path:
    if order.out is None:
        check_folder(_FOLDER)
        stamp = datetime.now().astimezone().strftime("%Y%m%d-%H%M%S-%f")[:-3]
        return _FOLDER / f"{order.name}-{stamp}.mcap"
    if order.out.suffix != ".mcap":
        raise ConfigurationError(f"--out {order.out}: a session log ends in .mcap")
    return order.out


def _payload(experiment: Experiment, name: str | None) -> Any:
    known = experiment.payloads()
    if name is None or name == _EMPTY:
        return None
    if name not in known:
        listed = ", ".join(known) or "no payload"
        raise ConfigurationError(f"payload {name!r} is not in {experiment.source}; there: {listed}")
    return known[name]


def _tell(order: _Order, step: Step, *more: str) -> None:
    if not order.as_json:
        answer(*step.notes, *more)
    tell(step, order.as_json)


@verb("record")
@click.argument("file", type=NAMED_FILE, default=default_file)
@click.option("--seconds", type=FiniteRange(0.1, 86400.0), help="Length; default: until Ctrl-C.")
@out_option
@click.option(
    "--poses",
    "poses",
    type=NEW_FILE,
    metavar="YAML",
    help="Write the poses at rest to this file, for `home`.",
)
@json_option
def record_command(
    file: str, seconds: float | None, out: Path | None, poses: Path | None, as_json: bool
) -> None:
    """Log what the controller sends, without commanding anything; until Ctrl-C or for --seconds.

    The PC answers in monitor mode only, so any motion is the controller's own: a KRL program, or a person guiding
    the arm in gravity compensation started at the pendant. Poses in which the arm rests for a second are listed;
    the last one is a home pose for `moves.home` of the experiment file.

    \b
    lwr-run record my_lab.yaml --seconds 10
    lwr-run record my_lab.yaml --out guided.mcap --poses poses.yaml
    """
    order = _Order("record", file, out, as_json=as_json)
    step = _run(order, lambda steps, path: steps.record(path, seconds))
    lines = [f"{pose.name} at {pose.time_s:.1f} s: {_row(pose)} rad" for pose in step.poses]
    if poses is not None:
        if not step.poses:
            raise ConfigurationError(f"the arm never rested for a second, so {poses} is not written; {step}")
        _write_poses(poses, step)
        lines.append(f"poses: {poses}; the last one is there as `moves.home`, for the experiment file")
    _tell(order, step, *lines)


def _row(pose: Pose) -> str:
    return "[" + ", ".join(f"{angle:.4f}" for angle in pose.q) + "]"


def _write_poses(path: Path, step: Step) -> None:
    lines = [f"# Poses at rest in {step.log} [rad], by `lwr-run record`", "poses:"]
    lines += [f"  {pose.name}: {_row(pose)}" for pose in step.poses]
    lines += ["# For the experiment file:", "moves:", f"  home: {_row(step.poses[-1])}"]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


@verb("hold")
@click.argument("file", type=NAMED_FILE, default=default_file)
@click.option(
    "--seconds",
    default=5.0,
    show_default=True,
    type=FiniteRange(0.5, 3600.0),
    help="Time in command mode.",
)
@_step_options
def hold_command(
    file: str,
    seconds: float,
    payload: str | None,
    out: Path | None,
    yes: bool,
    allow_non_realtime: bool,
    as_json: bool,
) -> None:
    """Enter command mode, hold the present pose, and leave command mode: the first step with the drives on.

    Checked before: link, real-time rights, torques at rest against gravity of the arm and --payload, clearance.
    The arm must not move; a sag means wrong load data. Ctrl-C once ends it, twice drops the link.

    \b
    lwr-run hold my_lab.yaml --seconds 5
    """
    question = f"The arm will hold its pose in command mode for {seconds:g} s."
    order = _Order("hold", file, out, payload, question, yes, allow_non_realtime, as_json)
    _tell(order, _run(order, lambda steps, path: steps.hold(path, seconds)))


@verb("jog", context_settings={"ignore_unknown_options": True})
@click.argument("joint", callback=_no_option)
@click.argument("degrees", type=FiniteRange())
@click.argument("file", type=NAMED_FILE, default=default_file, callback=_no_option)
@speed_option
@_step_options
def jog_command(
    joint: str,
    degrees: float,
    file: str,
    speed: float,
    payload: str | None,
    out: Path | None,
    yes: bool,
    allow_non_realtime: bool,
    as_json: bool,
) -> None:
    """Move one JOINT (A1 A2 E1 A3 A4 A5 A6) by DEGREES, at most 30, then leave command mode.

    Checked before: every limit of the motion, clearance to arm and cell, torque, link, torques at rest. Ctrl-C once
    stops the arm within its limits, twice drops the link. Nothing resumes by itself.

    \b
    lwr-run jog A6 5 my_lab.yaml
    lwr-run jog A6 -5 my_lab.yaml --speed 0.05
    """
    from lwr_driver.arm import Arm
    from runner.experiment_file import Experiment
    from runner.steps import jogged

    experiment = Experiment.load(file)
    jogged(Arm.load(experiment.arm, beside=experiment.folder).joint_names, joint, degrees)
    question = f"{joint.upper()} will move by {degrees:+g} degrees."
    order = _Order("jog", file, out, payload, question, yes, allow_non_realtime, as_json)
    _tell(order, _run(order, lambda steps, path: steps.jog(path, joint, degrees, speed)))


@verb("home")
@click.argument("file", type=NAMED_FILE, default=default_file)
@click.option(
    "--poses", type=PATH, metavar="YAML", help="Poses of `lwr-run record`; default: `moves.home` of FILE."
)
@click.option("--pose", metavar="NAME", help="One of --poses; default: its `moves.home`.")
@speed_option
@_step_options
def home_command(
    file: str,
    poses: Path | None,
    pose: str | None,
    speed: float,
    payload: str | None,
    out: Path | None,
    yes: bool,
    allow_non_realtime: bool,
    as_json: bool,
) -> None:
    """Move to the home position of the experiment FILE, or to a recorded pose, on a straight line in joint space.

    Checked as `jog`. If the way is not free, nothing moves: go around with `jog`, or guide the arm by hand.

    \b
    lwr-run home my_lab.yaml
    lwr-run home my_lab.yaml --poses poses.yaml --pose pose_2
    """
    from runner.experiment_file import Experiment

    if pose is not None and poses is None:
        raise ConfigurationError(f"--pose {pose} needs --poses, the file that it is in")
    name = pose or "home"
    joints = 7
    goal = Experiment.load(file).home(joints) if poses is None else _read_pose(poses, pose, joints)
    order = _Order(
        "home", file, out, payload, f"The arm will move to {name}.", yes, allow_non_realtime, as_json
    )
    _tell(order, _run(order, lambda steps, path: steps.home(path, goal, speed, name)))


def _read_pose(path: Path, name: str | None, joints: int) -> Any:
    import numpy as np

    from lwr_driver.configuration import read_mapping

    content = read_mapping(path)
    try:
        found = content["moves"]["home"] if name is None else content["poses"][name]
        q = np.array(found, dtype=np.float64)
    except (KeyError, TypeError, ValueError) as error:
        known = content.get("poses")
        listed = ", ".join(map(str, known)) if isinstance(known, dict) else "none"
        raise ConfigurationError(f"{path}: no pose {name or 'moves.home'}; poses there: {listed}") from error
    if q.shape != (joints,) or not np.all(np.isfinite(q)) or np.abs(q).max() > 2.0 * np.pi:
        degrees = q.shape == (joints,) and 2.0 * np.pi < np.abs(q).max() <= 360.0
        raise ConfigurationError(
            f"{path}: pose {name or 'moves.home'} must be {joints} joint positions in rad"
            + ("; these look like deg" if degrees else "")
        )
    return q
