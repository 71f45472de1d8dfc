from __future__ import annotations

from fri.states import (
    ALLOWED_FLAGS,
    CONTROL_BY_STRATEGY,
    FLAGS,
    STRATEGY_BY_CONTROL,
    TRANSITIONS,
    CommandFlag,
    Control,
    Quality,
    State,
    Trigger,
)


def test_numbers_are_the_protocols():
    assert [int(state) for state in State] == [0, 1, 2]
    assert [quality.name for quality in sorted(Quality)] == ["UNACCEPTABLE", "BAD", "OK", "PERFECT"]
    assert {control.name: int(control) for control in Control} == {
        "OTHER": 0,
        "POSITION": 1,
        "CART_IMP": 2,
        "JNT_IMP": 3,
    }
    assert [int(flag) for flag in CommandFlag] == [0x1, 0x4, 0x10, 0x20, 0x100, 0x400, 0x1000, 0x2000]


def test_flag_sets_are_those_that_clients_send():
    assert int(FLAGS[Control.POSITION]) == 0x0001
    assert int(FLAGS[Control.JNT_IMP]) == 0x0035
    assert int(FLAGS[Control.CART_IMP]) == 0x3500
    for control in Control:
        assert FLAGS[control] & ~ALLOWED_FLAGS[control] == 0


def test_command_mode_is_reached_from_monitor_mode_by_start_alone():
    assert [key for key, state in TRANSITIONS.items() if state is State.CMD] == [
        (State.MON, Trigger.FRI_START)
    ]


def test_every_fault_leads_to_monitor_mode():
    assert {state for (_, trigger), state in TRANSITIONS.items() if trigger is Trigger.FAULT} == {State.MON}


def test_strategies_and_control_modes_are_inverse():
    assert CONTROL_BY_STRATEGY == {10: Control.POSITION, 20: Control.CART_IMP, 30: Control.JNT_IMP}
    assert all(CONTROL_BY_STRATEGY[number] is control for control, number in STRATEGY_BY_CONTROL.items())
