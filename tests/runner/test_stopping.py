"""Preflight of stops on the default exciting motion."""

from __future__ import annotations

import dataclasses
import re
from functools import cache

import numpy as np
import pinocchio as pin
import pytest

from fri.errors import RefusedError
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Box, Cell
from lwr_driver.configuration import find
from lwr_driver.guard import Stop
from lwr_driver.motion import Motion
from runner.experiment_file import Experiment, Payload
from runner.planning import checker, excitation_rows, read_plan, session_motion
from runner.preflight import check_path, check_torque, loaded_model
from runner.stopping import check_stops, stop_clearance, stop_torque

T = 0.005
MARGIN = 0.015
# Passed at 18 mm, and hit by an arm stopped some 7.1 s after the beginning of the motion.
POST = Box("post", (0.01, 0.01, 0.01), (-0.55113544, -0.27294356, 0.35451399))
ARM = Arm.load()


def load(mass: float) -> Payload:
    return Payload("load", mass, (0.0, -0.066, 0.144))


@cache
def default_motion() -> Motion:
    return excitation_rows(read_plan(find("plans/default.plan.yaml"), ARM), 1)(T)


def test_post_that_only_a_stop_hits_is_refused_by_name():
    cell = Cell(ground_z_m=None, margin_m=MARGIN, boxes=(POST,))
    collision = checker(ARM, cell, load(3.34))
    assert check_path(collision, default_motion(), MARGIN).ok
    item = stop_clearance(collision, default_motion(), MARGIN)
    assert not item.ok
    assert item.subject == "clearance of a stop"
    assert re.match(r"-1\d mm, link_7 to post, stop at t = 7\.\d+ s, ", item.value)
    assert item.limit == "15 mm"
    assert "each joint by itself" in item.advice


def test_session_with_a_post_in_the_way_of_its_stops_does_not_move():
    experiment = Experiment.load()
    experiment = dataclasses.replace(
        experiment, moves=dataclasses.replace(experiment.moves, clearance_m=MARGIN)
    )
    cell = Cell(ground_z_m=None, margin_m=MARGIN, boxes=(POST,))
    home = experiment.home(7)
    _, preflight = session_motion(experiment, ARM, cell, experiment.sessions[1], default_motion(), home)
    with pytest.raises(
        RefusedError, match=r"clearance of a stop: -1\d mm, link_7 to post, stop at t = .*, limit 15 mm"
    ):
        preflight.enforce()


def test_default_motion_keeps_its_clearance_in_every_stop():
    cell = Cell.load()
    collision = checker(ARM, cell, load(3.34))
    torque, clearance = check_stops(ARM, collision, default_motion(), load(3.34), 0.03)
    assert clearance.ok
    assert clearance.value.startswith("33 mm, link_6 to ground")
    assert torque.ok
    assert torque.subject == "torque of a stop"


def test_payload_too_heavy_for_a_stop_is_refused_with_joint_torque_and_limit():
    # The motion alone needs 0.72 of the limit, its worst stop 0.90.
    assert check_torque(ARM, default_motion(), load(7.0)).ok
    item = stop_torque(ARM, default_motion(), load(7.0))
    assert not item.ok
    assert item.value.startswith("A2 15")
    assert item.limit == "140.8 Nm"
    assert "acceleration_rad_s2" in item.advice


def test_torque_of_a_stop_is_the_largest_one_of_the_rows_that_the_guard_commands():
    motion, payload = default_motion(), load(5.0)
    item = stop_torque(ARM, motion, payload)
    model, stop = loaded_model(ARM, payload), Stop(ARM.limits, T)
    data, largest = model.createData(), np.zeros(7)
    for row in range(3, len(motion), 50):
        stop.begin(*motion.q[[row, row - 1, row - 2]])
        rows = [motion.q[row - 1], motion.q[row]]
        while not stop.finished:
            rows.append(stop.advance(1))
        q = np.array([*rows, rows[-1]])
        qd, qdd = (q[2:] - q[:-2]) / (2 * T), np.diff(q, 2, axis=0) / T**2
        for state in zip(q[1:-1], qd, qdd, strict=True):
            largest = np.maximum(largest, np.abs(pin.rnea(model, data, *state)))
    joint, torque, *_ = item.value.split()
    of_all = float(largest[ARM.joint_names.index(joint)])
    assert np.argmax(largest / ARM.tau_max) == ARM.joint_names.index(joint)
    assert of_all * 0.995 <= float(torque) <= of_all * 1.03


def test_motion_at_rest_has_the_torque_of_gravity():
    still = Motion(np.tile(default_motion().q[0], (30, 1)), T)
    torque = stop_torque(ARM, still, None)
    assert torque.value.split()[1] == check_torque(ARM, still, None).value.split()[1]
