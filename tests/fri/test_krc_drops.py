"""What ends command mode: missing and malformed answers, wrong flags, limits, quality, drives."""

from __future__ import annotations

import numpy as np
import pytest

from fri.krc import EventKind
from fri.states import ALL_DRIVES, Quality, State
from tests.fri.fri_rig import LIMITS, Q_MAX, Q_START, STEP, Rig, accelerate


def test_missing_answers_beyond_the_bridge():
    rig = Rig(bridged_cycles=3).command_mode()
    results = [rig.cycle(reply=False) for _ in range(4)]
    assert [result.state for result in results] == [State.CMD] * 3 + [State.MON]
    drop = results[-1].drop
    assert drop is not None
    assert drop.kind is EventKind.MISSES
    assert drop.text == "4 answers in a row are missing, at most 3 are bridged"


def refused(rig: Rig, *args: object, **fields: object) -> EventKind:
    """Kind of the drop that one more cycle causes; the session must then be out of step in monitor mode."""
    setpoint = rig.cycle(*args, **fields)
    assert setpoint.drop is not None
    assert setpoint.state is rig.session.state is State.MON
    assert rig.session.needs_resync
    assert rig.session.last_event is setpoint.drop
    assert rig.session.counters()["drops"] == 1
    return setpoint.drop.kind


@pytest.mark.parametrize("datagram", [b"", b"x" * 375, b"x" * 376, b"x" * 916])
def test_malformed_datagram(datagram):
    rig = Rig().command_mode()
    rig.begin()
    rig.session.receive(datagram)
    rig.session.receive(rig.answer())
    setpoint = rig.session.close_cycle()
    assert setpoint.drop is not None
    assert setpoint.drop.kind is EventKind.MALFORMED


def test_malformed_datagram_can_be_made_a_mere_miss():
    rig = Rig(drop_on_malformed=False).command_mode()
    rig.begin()
    rig.session.receive(b"x" * 100)
    assert rig.session.close_cycle().state is State.CMD


@pytest.mark.parametrize("flags", [0, 0x11, 0x35, 0x3500])
def test_flags_changed_in_command_mode(flags):
    assert refused(Rig().command_mode(), cmd_flags=flags) is EventKind.FLAGS_CHANGED


def started_with(strategy: int, flags: int) -> Rig:
    """A session in another control mode, before the first cycle of command mode, and a client with these flags."""
    rig = Rig()
    rig.session.set_strategy(strategy)
    rig.flags_follow = False
    rig.cmd["cmd_flags"] = flags
    rig.open().cycles(20)
    rig.session.fri_start()
    return rig


@pytest.mark.parametrize(
    ("strategy", "flags"), [(10, 0), (10, 0x35), (10, 0x3500), (30, 0x3500), (20, 0x35), (30, 0x1000)]
)
def test_flags_that_do_not_fit_the_control_mode(strategy, flags):
    assert refused(started_with(strategy, flags)) is EventKind.WRONG_FLAGS


@pytest.mark.parametrize(
    ("strategy", "flags"), [(10, 0x1), (30, 0x35), (30, 0x1), (20, 0x3500), (20, 0x3501), (101, 0x35)]
)
def test_flags_that_fit(strategy, flags):
    assert started_with(strategy, flags).cycles(5).state is State.CMD


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("first", [True, False])
def test_position_that_is_no_number(value, first):
    rig = Rig().command_mode() if not first else Rig().open()
    if first:
        rig.cycles(20)
        rig.session.fri_start()
    q = Q_START.copy()
    q[4] = value
    assert refused(rig, q) is EventKind.NOT_FINITE
    assert "A4" in rig.session.last_event.text


@pytest.mark.parametrize("field", ["add_jnt_trq", "jnt_stiffness", "jnt_damping"])
def test_flagged_field_that_is_no_number(field):
    rig = Rig()
    rig.session.set_strategy(30)
    rig.command_mode()
    assert refused(rig, **{field: np.nan}) is EventKind.NOT_FINITE
    assert field in rig.session.last_event.text


def test_first_command_away_from_the_mirror():
    rig = Rig().open()
    rig.cycles(20)
    rig.session.fri_start()
    q = Q_START.copy()
    q[2] += 1.1e-3
    assert refused(rig, q) is EventKind.NOT_MIRRORED
    assert rig.session.last_event.text.startswith("FRI interpolation error: E1 of the first command")


def test_command_away_from_the_mirror_with_the_drives_off():
    rig = Rig().open()
    rig.session.set_drives(0)
    rig.cycles(20)
    rig.session.fri_start()
    rig.cycles(5)
    assert refused(rig, Q_START + 2e-3) is EventKind.NOT_MIRRORED


@pytest.mark.parametrize("joint", range(7))
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_position_limit(joint, side):
    q = np.zeros(7)
    q[joint] = side * (Q_MAX[joint] - 1e-4)
    rig = Rig(q=q).command_mode()
    q[joint] = side * Q_MAX[joint]
    assert rig.cycle(q).state is State.CMD
    q[joint] += side * 1e-5
    assert refused(rig, q) is EventKind.POSITION


def test_extrapolation_over_a_position_limit():
    q = np.zeros(7)
    q[0] = Q_MAX[0] - 2.2 * STEP[0]
    rig = Rig(q=q).command_mode()
    step = np.zeros(7)
    step[0] = STEP[0]
    accelerate(rig, 2, step)
    assert refused(rig, reply=False) is EventKind.POSITION
    assert "extrapolated" in rig.session.last_event.text
    assert (rig.cycles(300).position <= Q_MAX).all()


@pytest.mark.parametrize("joint", range(7))
def test_velocity_limit(joint):
    rig = Rig().command_mode()
    q = rig.session.setpoint
    q[joint] += STEP[joint]
    assert rig.cycle(q).state is State.CMD
    q[joint] += STEP[joint] * 1.005
    assert refused(rig, q) is EventKind.VELOCITY
    assert "excessive commanded joint speed" in rig.session.last_event.text


def test_limit_factor_of_fristart_shrinks_the_velocity_limit():
    rig = Rig().open()
    rig.cycles(20)
    rig.session.fri_start(0.5)
    rig.cycle()
    assert rig.begin()["safety_limits"] == 0.5
    rig.session.receive(rig.answer(rig.session.setpoint + 0.49 * STEP))
    assert rig.session.close_cycle().state is State.CMD
    assert refused(rig, rig.session.setpoint + 0.51 * STEP) is EventKind.VELOCITY
    with pytest.raises(ValueError, match="limit factor"):
        rig.session.fri_start(1.5)


def test_t1_shrinks_the_velocity_limit():
    rig = Rig(t1_velocity_factor=0.1).command_mode()
    rig.session.t1 = True
    assert rig.cycle(rig.session.setpoint + 0.09 * STEP).state is State.CMD
    assert refused(rig, rig.session.setpoint + 0.2 * STEP) is EventKind.VELOCITY
    assert "in T1" in rig.session.last_event.text


def test_acceleration_limit_where_it_is_asked_for():
    change = LIMITS.a_max * 1e-6
    rig = Rig(acceleration_factor=1.0).command_mode()
    accelerate(rig, 5, 0.9 * change)
    q = rig.session.setpoint
    assert rig.cycle(q + 1.8 * change).state is State.CMD
    assert refused(rig, rig.session.setpoint + 3.5 * change) is EventKind.ACCELERATION


def test_acceleration_limit_allows_for_bridged_cycles():
    change = 0.95 * LIMITS.a_max * 1e-6
    rig = Rig(acceleration_factor=1.0, bridged_cycles=3, hold_quality=Quality.UNACCEPTABLE).command_mode()
    for k in range(1, 40):
        q = Q_START + change * k * (k + 1) / 2
        assert rig.cycle(q, reply=k % 5 not in (2, 3, 4)).state is State.CMD


def test_quality_that_becomes_unacceptable():
    rig = Rig().command_mode()
    rig.session.quality_ceiling = Quality.BAD
    assert rig.cycles(3).state is State.CMD
    rig.session.quality_ceiling = Quality.UNACCEPTABLE
    assert refused(rig) is EventKind.QUALITY


def test_sporadic_misses_within_the_bridge_end_in_bad_quality():
    rig = Rig(bridged_cycles=3).command_mode()
    drop = None
    for k in range(30):
        drop = drop or rig.cycle(reply=k % 2 == 0).drop
    assert drop is not None
    assert drop.kind is EventKind.QUALITY


def test_drives_off():
    rig = Rig().command_mode()
    rig.session.set_drives(0)
    setpoint = rig.cycle()
    assert (setpoint.state, setpoint.drop.kind) == (State.MON, EventKind.DRIVES_OFF)


def test_drive_error_names_the_drives():
    rig = Rig().command_mode()
    rig.session.set_drives(ALL_DRIVES, error=0b0000101)
    setpoint = rig.cycle()
    assert setpoint.drop.kind is EventKind.DRIVE_ERROR
    assert setpoint.drop.text == "drive error of A1, E1"


def test_reason_from_outside():
    rig = Rig().command_mode()
    rig.session.drop(EventKind.EXTERNAL, "emergency stop")
    setpoint = rig.cycle()
    assert setpoint.drop.text == "emergency stop"
    assert rig.cycle().drop is None
