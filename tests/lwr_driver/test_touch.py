"""The loop when something touches the arm, when the link is rated bad, and after any of it."""

from __future__ import annotations

import numpy as np
import pytest

from fri.states import EventKind, Quality, State
from lwr_driver.commander import CONTACT, RETREAT
from lwr_driver.contact import Contact, Stale
from lwr_driver.control import Mode, Result, Text, Word
from lwr_driver.loop import _UNACCEPTABLE_PACKETS
from lwr_driver.motion import move_to
from lwr_driver.ring import Ring
from tests.lwr_driver.driver_rig import HOP, Rig, arm, check_sent, in_motion
from tests.lwr_driver.driver_twins import Watched

PUSH = Contact("external torque by the model", 1, 31.0, 16.8)


class Hand:
    """Stands in for the watch: says and feels what the test wants."""

    def __init__(self) -> None:
        self.external, self.allowed = np.zeros(7), np.full(7, 10.0)
        self.contact: Contact | None = None
        self.stale: Stale | None = None
        self.carried: list[list[float]] = []

    def set_period(self, period_s: float) -> None:
        pass

    def weigh(self, *_: object) -> None:
        pass

    def carry(self, mass: float, com: np.ndarray, inertia: np.ndarray) -> None:
        self.carried.append([mass, *com, *inertia])

    def update(self, *_: object) -> Contact | None:
        return self.contact


class Idle:
    """A KRL program that does nothing."""

    def advance(self, milliseconds: int) -> None:
        pass


@pytest.fixture
def rig(rig):
    return lambda period_ms=5, **options: rig(period_ms, watch=Hand(), **options)


def hand(r: Rig) -> Hand:
    watch = r.loop._watch
    assert isinstance(watch, Hand)
    return watch


def refused(r: Rig, result: Result = Result.ROBOT) -> str:
    """Why another motion is refused, after a contact as a fault of the robot."""
    rows = len(r.arrived.rows)
    r.start(move_to(arm(), r.target, r.target + 0.1 * HOP, r.period_s))
    assert r.until_done() is result
    r.cycles(5)
    assert len({row.tobytes() for row in r.arrived.rows[rows:]}) <= 1
    return r.reason


@pytest.mark.parametrize("period_ms", [1, 5])
def test_contact_stops_the_motion_in_the_same_cycle_and_names_itself(rig, period_ms):
    r = rig(period_ms)
    in_motion(r)
    hand(r).contact = PUSH
    r.cycle()
    assert r.mode is Mode.STOP
    hand(r).contact = None
    assert r.until_done() is Result.ROBOT
    assert r.reason.startswith("contact: A2 external torque by the model 31.0 Nm exceeds 16.8 Nm at row ")
    assert "check its payload" in r.reason
    assert r.mode is Mode.HOLD
    check_sent(r)


def test_after_a_contact_only_a_new_request_for_command_mode_allows_a_motion(rig):
    r = rig()
    in_motion(r)
    hand(r).contact = PUSH
    r.cycle()
    hand(r).contact = None
    r.until_done()
    assert r.control.text(Text.LEFT) == r.reason
    assert "no motion before `enter_command`: contact: A2" in refused(r)
    r.enter()
    assert r.control.text(Text.LEFT) == ""
    r.start(move_to(arm(), r.target, r.target - 0.5 * HOP, r.period_s))
    assert r.until_done() is Result.DONE
    check_sent(r)


def test_an_arm_still_pressed_goes_back_the_way_it_came_and_no_further(rig):
    r = rig()
    motion = in_motion(r)
    before = r.loop._commander.index - round(0.05 / r.period_s)
    hand(r).contact = PUSH
    # Against the motion of A2, which runs downwards.
    hand(r).external[1] = 20.0
    r.cycle()
    hand(r).contact = None
    r.until_done()
    assert r.reason.endswith("still pressed at rest, the arm went back")
    assert np.allclose(r.target, motion.q[before], atol=1e-6)
    lowest, highest = np.min(r.arrived.rows, axis=0), np.max(r.arrived.rows, axis=0)
    assert np.all(lowest >= np.minimum(motion.q[0], motion.q[-1]) - 1e-6)
    assert np.all(highest <= np.maximum(motion.q[0], motion.q[-1]) + 1e-6)
    check_sent(r)


@pytest.mark.parametrize("external", [0.0, -20.0, 4.0], ids=["free", "from behind", "lightly"])
def test_an_arm_that_is_not_pressed_back_stays_where_it_stopped(rig, external):
    r = rig()
    in_motion(r)
    hand(r).contact = PUSH
    hand(r).external[1] = external
    r.cycle()
    hand(r).contact = None
    r.until_done()
    assert "went back" not in r.reason
    assert r.loop._commander.phase != RETREAT
    check_sent(r)


def test_something_in_the_way_back_ends_the_retreat(rig):
    r = rig()
    motion = in_motion(r)
    before = r.loop._commander.index - round(0.05 / r.period_s)
    hand(r).contact, hand(r).external[1] = PUSH, 20.0
    r.cycle()
    hand(r).contact = None
    while r.loop._commander.phase != RETREAT:
        r.cycle()
    r.cycles(10)
    hand(r).external[1] = -20.0
    r.until_done()
    assert np.abs(r.target - motion.q[before]).max() > 0.01
    assert r.mode is Mode.HOLD
    check_sent(r)


def test_retreat_with_lost_packets_keeps_the_limits(rig):
    r = rig()
    in_motion(r)
    hand(r).contact, hand(r).external[1] = PUSH, 20.0
    r.cycle()
    hand(r).contact = None
    number = 0
    while not r.done:
        number += 1
        r.cycle(lose_packet=number % 5 == 0)
    assert "went back" in r.reason
    check_sent(r)


def test_contact_at_rest_allows_no_motion(rig):
    r = rig()
    r.enter()
    hand(r).contact = PUSH
    r.cycles(3)
    assert r.mode is Mode.HOLD
    assert "in mode hold" in r.control.text(Text.LEFT)
    assert "contact: A2" in refused(r)
    # As long as it is touched, command mode alone does not help.
    r.enter()
    assert "contact: A2" in refused(r)
    hand(r).contact = None
    r.enter()
    r.start(move_to(arm(), r.target, r.target + 0.1 * HOP, r.period_s))
    assert r.until_done() is Result.DONE


def test_contact_in_monitor_mode_is_nobodys_business(rig):
    r = rig()
    hand(r).contact = PUSH
    r.cycles(50)
    hand(r).contact = None
    in_motion(r)
    assert r.until_done() is Result.DONE


def test_contact_during_a_stop_on_request_is_told_and_bars(rig):
    r = rig()
    in_motion(r)
    r.stop()
    r.cycles(2)
    hand(r).contact = PUSH
    r.cycles(2)
    hand(r).contact = None
    assert r.until_done() is Result.ABORTED
    assert "stop requested" in r.reason
    assert "then contact: A2" in r.reason
    assert "contact: A2" in refused(r)


def test_payload_reaches_the_watch_while_the_arm_rests(rig):
    r = rig()
    in_motion(r)
    load = [3.34, 0.01, -0.07, 0.14, 0.02, 0.03, 0.04]
    r.control.load[:] = load
    r.control.words[Word.LOAD] += 1
    r.cycles(3)
    assert hand(r).carried == []
    r.until_done()
    r.cycles(2)
    assert hand(r).carried == [load]
    r.cycles(2)
    assert hand(r).carried == [load]


def test_contact_after_the_answer_has_left_stops_with_the_next_packet(rig):
    with Ring.create(2000) as ring:
        r = rig(lock_step=False, ring=ring)
        ahead = Watched(r)
        r.loop.turnaround = ahead
        r.timeout_s = 0.0
        in_motion(r)
        sent = ahead.answered
        hand(r).contact = PUSH
        r.cycle()
        assert ahead.answered == sent + 1
        assert r.mode is Mode.MOTION
        r.cycle()
        assert ahead.answered == sent + 1
        assert r.mode is Mode.STOP
        hand(r).contact = None
        assert r.until_done() is Result.ROBOT
        assert "contact: A2" in r.reason
        assert "contact: A2" in refused(r)
        assert r.mode is Mode.HOLD
        check_sent(r)


def test_contact_in_the_packet_that_begins_a_motion_ends_it(rig):
    with Ring.create(2000) as ring:
        r = rig(lock_step=False, ring=ring)
        ahead = Watched(r)
        r.loop.turnaround = ahead
        r.timeout_s = 0.0
        r.enter()
        motion = move_to(arm(), r.target, r.target + HOP, r.period_s)
        r.start(motion)
        hand(r).contact = PUSH
        r.cycle()
        hand(r).contact = None
        assert r.until_done() is Result.ROBOT
        assert r.mode is Mode.HOLD
        assert np.allclose(r.target, motion.q[0], atol=1e-4)
        check_sent(r)


# -- quality -----------------------------------------------------------------------------------------------------

LENIENT = {"hold_quality": Quality.UNACCEPTABLE}


def test_stale_measurement_ends_the_motion_by_its_own_name(rig):
    r = rig()
    in_motion(r)
    hand(r).stale = Stale(1, 0.015, 0.93)
    r.cycle()
    assert r.mode is Mode.STOP
    assert r.until_done() is Result.ROBOT
    assert r.reason.startswith(
        "stale measurement: A2 measured position has not changed for 0.015 s at 0.93 rad/s at row "
    )
    assert "contact" not in r.reason
    check_sent(r)


def test_an_arm_that_stopped_at_once_before_the_motion_is_no_stale_measurement(rig):
    r = rig()
    hand(r).stale = Stale(1, 0.45, 0.09)
    in_motion(r, 20)
    assert r.mode is Mode.MOTION


def test_unacceptable_quality_in_command_mode_stops_the_motion(rig):
    r = rig(policy=LENIENT)
    in_motion(r)
    r.session.quality_ceiling = Quality.UNACCEPTABLE
    rated = 0
    while r.mode is Mode.MOTION:
        r.cycles(1)
        rated += r.loop.remote.quality == Quality.UNACCEPTABLE
    assert rated == _UNACCEPTABLE_PACKETS
    assert r.until_done() is Result.NETWORK
    assert r.session.state is State.CMD
    assert "the controller rates the link UNACCEPTABLE in command mode" in r.reason
    assert r.mode is Mode.HOLD
    check_sent(r)


def test_bad_quality_is_borne_for_a_second(rig):
    r = rig(policy=LENIENT)
    r.enter()
    motion = move_to(arm(), r.target, r.target + HOP, r.period_s, speed_scale=0.1)
    assert motion.duration_s > 2.5
    r.start(motion)
    r.cycles(20)
    r.session.quality_ceiling = Quality.BAD
    r.cycles(150)
    r.session.quality_ceiling = Quality.PERFECT
    r.cycles(10)
    r.session.quality_ceiling = Quality.BAD
    r.cycles(190)
    assert r.mode is Mode.MOTION
    assert r.until_done() is Result.NETWORK
    assert "rates the link BAD in command mode, 1.000 s below OK" in r.reason
    check_sent(r)


# -- after a fallback --------------------------------------------------------------------------------------------


def test_controller_that_returns_to_command_mode_unasked_gets_no_motion(rig):
    r = rig()
    in_motion(r)
    r.session.drop(EventKind.EXTERNAL, "emergency stop")
    assert r.until_done() is Result.ROBOT
    left = r.control.text(Text.LEFT)
    r.cycles(60)
    # By itself: nobody asked for it, and the KRL program looks away.
    program, r.interpreter = r.interpreter, Idle()
    r.session.resync(r.session.setpoint)
    r.session.fri_start()
    r.cycles(100)
    assert r.session.state is State.CMD
    assert r.mode is Mode.HOLD
    assert r.control.text(Text.LEFT) == left
    assert f"no motion before `enter_command`: {left}" in refused(r, Result.REFUSED)
    r.session.fri_stop()
    r.cycles(20)
    r.interpreter = program
    r.enter()
    assert r.control.text(Text.LEFT) == ""
    r.start(move_to(arm(), r.target, r.target + 0.1 * HOP, r.period_s))
    assert r.until_done() is Result.DONE
    check_sent(r)


def test_phases_tell_stop_and_retreat_apart(rig):
    r = rig()
    in_motion(r)
    hand(r).contact, hand(r).external[1] = PUSH, 20.0
    phases = []
    for _ in range(400):
        r.cycle()
        hand(r).contact = None
        phases.append(r.loop._commander.phase)
        if r.done:
            break
    assert phases[0] == CONTACT
    assert RETREAT in phases
    assert phases == sorted(phases[:-1]) + phases[-1:]
