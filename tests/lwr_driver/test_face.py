"""The names of the package, their short texts, and errors for arguments of a wrong type."""

from __future__ import annotations

import dataclasses
import subprocess
import sys

import numpy as np
import pytest

import lwr_driver
from fri.errors import ConfigurationError
from lwr_driver import Arm, Cell, CollisionChecker, Driver, LinkSettings, Motion, move_to
from tests.lwr_driver.driver_rig import START, arm


def modules_after(line: str) -> set[str]:
    code = f"import sys; {line}; print(*sys.modules)"
    return set(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.split())


def test_package_alone_loads_nothing_heavy():
    loaded = modules_after("import lwr_driver")
    assert "lwr_driver" in loaded
    assert not loaded & {"numpy", "yaml", "ruckig", "pinocchio", "scipy"}


def test_loop_process_loads_only_what_it_runs():
    loaded = modules_after("import lwr_driver.loop_process")
    assert not loaded & {"pinocchio", "coal", "scipy", "numba", "zstandard"}
    ours = {name.removeprefix("lwr_driver.") for name in loaded if name.startswith("lwr_driver.")}
    assert ours == {
        "arm",
        "arm.ceilings",
        "arm.description",
        "commander",
        "configuration",
        "contact",
        "control",
        "cycle_rows",
        "guard",
        "loop",
        "loop_process",
        "means",
        "pace",
        "places",
        "realtime",
        "references",
        "ring",
        "setpoint",
        "yaml_text",
    }


def test_every_public_name_is_there():
    for name in lwr_driver.__all__:
        assert getattr(lwr_driver, name).__name__ == name
    assert set(lwr_driver.__all__) <= set(dir(lwr_driver))


@pytest.mark.parametrize("module", [lwr_driver, lwr_driver.arm])
def test_unknown_name_is_an_attribute_error(module):
    with pytest.raises(AttributeError, match="no attribute 'Leg'"):
        _ = module.Leg


def test_arm_shows_its_limits_in_a_few_lines():
    lines = repr(Arm.load()).splitlines()
    assert len(lines) <= 10
    assert lines[0].startswith("Arm ")
    assert lines[1].split() == ["joint", *Arm.load().joint_names]


def test_driver_shows_arm_link_and_state_in_a_few_lines():
    text = repr(Driver(arm(), LinkSettings(address="127.0.0.1", port=0)))
    assert len(text.splitlines()) <= 10
    assert "127.0.0.1:0" in text
    assert "not connected" in text


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: Driver("192.168.0.1", LinkSettings()), r"arm of the driver: expected an Arm.*Arm\.load"),
        (lambda: Driver(arm(), "192.168.0.1"), "link of the driver: expected a LinkSettings.*give"),
        (lambda: Driver(arm(), LinkSettings()).execute(START), "motion to execute: expected a Motion"),
        (lambda: Driver(arm(), LinkSettings()).record(3, {}), "session log: expected a path.*give it as"),
        (lambda: Arm.load(3), "configuration file: expected a path, found the int 3; give it as"),
        (lambda: CollisionChecker(arm(), None), r"cell of a collision check.*Cell\.load"),
        (lambda: CollisionChecker(Cell.load(), Cell.load()), r"arm of a collision check.*Arm\.load"),
        (lambda: Motion("rows", 0.001), "q is no array of numbers"),
        (lambda: move_to(arm(), "here", START, 0.001), "finite joint positions"),
        (lambda: move_to(START, START, START, 0.001), r"arm of a motion.*Arm\.load"),
    ],
)
def test_wrong_type_is_refused_with_advice(call, match):
    with pytest.raises(ConfigurationError, match=match):
        call()


def test_text_of_a_wrong_value_is_short():
    with pytest.raises(ConfigurationError) as caught:
        Driver("x" * 10_000, LinkSettings())
    assert len(str(caught.value)) < 300
    with pytest.raises(ConfigurationError) as caught:
        Driver(np.zeros((1000, 1000)), LinkSettings())
    assert len(str(caught.value)) < 300


def test_a_real_arm_keeps_its_ceilings_whatever_its_file_calls_it():
    names = tuple(f"joint_{number}" for number in range(7))
    other = dataclasses.replace(arm(), model="my arm", joint_names=names, a_max=np.full(7, 20.0))
    with pytest.raises(
        ConfigurationError, match=r"joint_0: acceleration_rad_s2 20 rad/s² is beyond 8 rad/s².*narrow"
    ):
        Driver(other, LinkSettings(address="127.0.0.1"))
    Driver(other, LinkSettings(address="127.0.0.1", lock_step=True))
