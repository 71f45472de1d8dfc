"""Draw the pictures of the documents that need no browser: effects, motions, terminal. `make pictures`.

The effects are drawn from their own columns, the terminal from real output of the commands.
"""

from __future__ import annotations

import contextlib
import os
import pty
import re
import subprocess
import sys
import tempfile
import termios
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("svg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

from ident.dynamics import regressor
from ident.dynamics.kinematics import Chain
from ident.effects import EFFECTS
from ident.effects.motion import ArmMotion
from ident.excitation.plan import ExcitationPlan
from lwr_driver.arm import Arm
from lwr_driver.configuration import CONFIGS

HERE = Path(__file__).resolve().parent

JOINT = 3
SEEN: dict[str, tuple[str, str, dict[str, float], str | None]] = {
    # cause: (variable on the abscissa, its label, values, form)
    "stribeck": ("qd", "velocity [rad/s]", {"amplitude": 4.0, "velocity": 0.05, "exponent": 2.0}, None),
    "viscous_nonlinear": ("qd", "velocity [rad/s]", {"coefficient": 3.0, "exponent": 2.0}, None),
    "friction_asymmetry": ("qd", "velocity [rad/s]", {"viscous": 1.0, "coulomb": 1.5}, "viscous and Coulomb"),
    "presliding_hysteresis": ("q", "position [rad]", {"amplitude": 4.0, "length": 0.03}, None),
    "gear_ripple": ("q", "position [rad]", {"cosine": 1.0, "cycles_per_turn": 1.0, "gear_ratio": 8.0}, None),
    "friction_load": ("load", "joint torque [Nm]", {"factor": 0.08}, None),
    "cable_spring": ("q", "position [rad]", {"stiffness": 4.0, "slack": 0.3}, "taut above"),
    "base_tilt": ("q", "position [rad]", {"tilt_x": 0.02, "tilt_y": 0.01}, None),
    "joint_zero_offset": ("q", "position [rad]", {"offset": 0.02}, None),
    "encoder_eccentricity": ("q", "position [rad]", {"cosine": 0.01, "sine": 0.0, "cycles_per_turn": 1.0}, None),
    "sensor_gain": ("load", "joint torque [Nm]", {"error": 0.06}, None),
    "sensor_hysteresis": ("load", "joint torque [Nm]", {"amplitude": 1.0, "width": 6.0}, None),
    "sensor_saturation": ("load", "joint torque [Nm]", {"share": 1.0, "limit": 8.0}, "fitted"),
    "joint_torque_delay": ("time", "time [s]", {"share": 1.0, "delay": 0.02}, None),
    "payload_error": ("q", "position [rad]", {"mass": 0.3, "moment_x": 0.0, "moment_y": 0.0, "moment_z": 0.03}, None),
    "joint_elasticity": ("load", "joint torque [Nm]", {"compliance": 1e-4}, "encoder at the link"),
}  # fmt: skip


def motion() -> ArmMotion:
    """One period of the default exciting motion of the LWR4+, with drives of viscous and Coulomb friction."""
    plan = ExcitationPlan.load(CONFIGS / "plans/default.plan.yaml")
    chain = Chain.from_urdf(Arm.load().urdf)
    time = np.arange(0.0, plan.period_s, 2e-3)
    sampled = plan.motion.sample(time)
    bodies = chain.inertial_from_links(chain.urdf_inertials())
    joint = regressor.torque(chain, sampled.q, sampled.qd, sampled.qdd, bodies)
    coulomb = np.full(7, 4.0)
    return ArmMotion(
        chain=chain, bodies=bodies, session=0, time=time, duration_s=plan.period_s,
        q=sampled.q, qd=sampled.qd, qdd=sampled.qdd, motor_speed=sampled.qd, motor_acceleration=sampled.qdd,
        joint_torque=joint, motor_torque=joint + 8.0 * sampled.qd + coulomb * np.sign(sampled.qd),
        gear_ratio=np.full(7, 100.0), inertia=np.zeros(7), link_coulomb=np.zeros(7), motor_coulomb=coulomb,
        friction=lambda speed: 8.0 * speed + 4.0 * np.sign(speed),
    )  # fmt: skip


def effect_torque(arm: ArmMotion, cause: str, values: Mapping[str, float], form: str | None) -> np.ndarray:
    """Torque (N,) that an effect adds at joint 4 [Nm], on the side where it is seen."""
    effect = EFFECTS[cause]
    shape = effect.shape_of(values, form)
    total = np.zeros(len(arm.time))
    for column, size in zip(effect.columns(arm, JOINT, shape), effect.coefficients_of(values), strict=False):
        motor, joint = column.wide(JOINT, arm.n)
        seen = joint if joint is not None else motor
        if seen is not None:
            total += size * seen[:, JOINT]
    return total


def draw_effects() -> None:
    """The torque of each effect over the variable that it depends on, along the default motion."""
    arm = motion()
    abscissa = {
        "q": arm.q[:, JOINT],
        "qd": arm.qd[:, JOINT],
        "load": arm.joint_torque[:, JOINT],
        "time": arm.time,
    }
    for cause, (variable, label, values, form) in SEEN.items():
        torque = effect_torque(arm, cause, values, form)

        def curve(axes: Axes, x: Any = abscissa[variable], y: Any = torque, label: str = label) -> None:
            axes.plot(x[::5], y[::5], lw=0.9)
            axes.axhline(0.0, color="0.7", lw=0.6, zorder=0)
            axes.set_xlabel(label)
            axes.set_ylabel("added torque [Nm]")

        save(f"effect_{cause}.svg", curve)


def draw_motion() -> None:
    """Position and velocity of the default exciting motion, beside the limits."""
    arm, limits = motion(), Arm.load()

    def positions(axes: Axes) -> None:
        axes.plot(arm.time, 100.0 * arm.q / np.where(arm.q > 0.0, limits.q_high, -limits.q_low), lw=0.9)
        decorate(axes, "position [% of the limit]")

    def velocities(axes: Axes) -> None:
        axes.plot(arm.time, 100.0 * arm.qd / limits.v_max, lw=0.9)
        decorate(axes, "velocity [% of the limit]")

    def torques(axes: Axes) -> None:
        axes.plot(arm.time, 100.0 * arm.joint_torque / limits.tau_max, lw=0.9)
        decorate(axes, "joint torque [% of the limit]")

    def decorate(axes: Axes, label: str) -> None:
        axes.set_xlabel("time [s]")
        axes.set_ylabel(label)
        axes.legend([f"{k}" for k in range(1, 8)], ncols=7, fontsize=6, frameon=False, loc="upper center")

    for name, curve in (("positions", positions), ("velocities", velocities), ("torques", torques)):
        save(f"motion_{name}.svg", curve, size=(5.4, 2.6))


def save(name: str, curve: Callable[[Axes], None], size: tuple[float, float] = (3.6, 2.4)) -> None:
    """Draw into a file that is the same each time."""
    with plt.rc_context({"svg.hashsalt": "lwr", "font.size": 8, "svg.fonttype": "none"}):
        figure, axes = plt.subplots(figsize=size, layout="constrained")
        axes.spines[["top", "right"]].set_visible(False)
        curve(axes)
        figure.savefig(HERE / name, metadata={"Date": None})
        plt.close(figure)


COLUMNS = 100


def at_terminal(command: list[str], place: str) -> str:
    """What a command shows at a terminal, with its colours."""
    leader, follower = pty.openpty()
    termios.tcsetwinsize(follower, (60, COLUMNS))
    kept = {key: value for key, value in os.environ.items() if key not in ("CI", "NO_COLOR", "COLUMNS")}
    variables = kept | {"TERM": "xterm-256color"}
    process = subprocess.Popen(
        command, cwd=place, env=variables, stdin=follower, stdout=follower, stderr=follower
    )
    os.close(follower)
    shown = b""
    with contextlib.suppress(OSError):  # the process has closed its end
        while data := os.read(leader, 65536):
            shown += data
    os.close(leader)
    process.wait()
    return shown.decode().replace("\r", "").rstrip()


def draw_terminal() -> None:
    """What some commands print, as text in a frame."""
    from rich.console import Console
    from rich.text import Text

    with tempfile.TemporaryDirectory() as place:
        for name, words in TERMINAL.items():
            shown = at_terminal([sys.executable, "-m", "runner.cli", *words], place)
            shown = shown.replace(f"{CONFIGS.parent}/", "")
            console = Console(record=True, width=COLUMNS, file=open("/dev/null", "w"))  # noqa: SIM115
            console.print(Text(f"$ lwr-run {' '.join(words)}", style="bold"))
            console.print(Text.from_ansi(shown))
            svg = console.export_svg(title="lwr-run", unique_id="lwr")
            # Fonts of the reader's computer, nothing is fetched.
            svg = re.sub(r"@font-face \{.*?\}\s*", "", svg, flags=re.DOTALL)
            (HERE / f"terminal_{name}.svg").write_text(svg, encoding="utf-8")


TERMINAL = {
    "check": ["check"],
    "schema": ["schema"],
    "example": ["example", "--list"],
    "help": ["-h"],
}

if __name__ == "__main__":
    draw_motion()
    draw_effects()
    draw_terminal()
