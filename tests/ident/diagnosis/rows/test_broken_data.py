"""Broken channels are told as that, and no cause is named from them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fri.errors import DataError
from ident.diagnosis import commission, diagnose
from ident.diagnosis.rows.broken_data import blamed, broken_channels, in_doubt, screened, worthless
from ident.dynamics.kinematics import Chain
from ident.model.model_file import read_model, write_model
from ident.rows.filters import SignalSettings
from lwr_driver.session import Session

Make = Callable[..., Session]
Edit = Callable[[np.ndarray], None]


def swapped(values: np.ndarray) -> None:
    values[:, [0, 1]] = values[:, [1, 0]]


def reversed_sign(values: np.ndarray) -> None:
    values[:, 1] *= -1.0


def milli(values: np.ndarray) -> None:
    values[:, 1] *= 1e3


def dead(values: np.ndarray) -> None:
    values[:, 2] = 0.0


def frozen(values: np.ndarray) -> None:
    count = len(values)
    values[count // 4 : 3 * count // 4, 1] = values[count // 4, 1]


def edited(sessions: list[Session], channel: str, field: str, edit: Edit) -> list[Session]:
    done = []
    for session in sessions:
        columns = getattr(session, channel)
        values = getattr(columns, field).copy()
        edit(values)
        done.append(replace(session, **{channel: replace(columns, **{field: values})}))
    return done


@pytest.fixture(scope="module")
def pair(make: Make) -> list[Session]:
    return [make("a.mcap", 1), make("b.mcap", 2, None, 1)]


@pytest.mark.slow
@pytest.mark.parametrize("side", ["motor", "joint"])
@pytest.mark.parametrize(
    ("edit", "joints", "words"),
    [
        (swapped, {1, 2}, "interchanged"),
        (reversed_sign, {2}, "reversed sign"),
        (milli, {2}, "mNm"),
        (dead, {3}, "dead sensor"),
        (frozen, {2}, "frozen"),
    ],
)
def test_a_broken_torque_is_data_and_no_cause(
    pair: list[Session], chain: Chain, side: str, edit: Edit, joints: set[int], words: str
) -> None:
    found = diagnose(edited(pair, side, "effort", edit), chain)
    assert {(one.channel, one.joint) for one in found.data} == {(f"{side} torque", joint) for joint in joints}
    assert (found.findings, found.unexplained) == ((), ())
    content = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert all(words in one["what"] and one["advice"] for one in content["data"])
    lines = str(found).splitlines()
    assert "cannot be what they say" in lines[1]
    assert words in str(found)


def test_torques_of_several_joints_in_another_unit_end_the_diagnosis(make: Make, chain: Chain) -> None:
    def drift(s: dict[str, np.ndarray]) -> None:
        s["motor"][:, 0] += 0.8 * (1.0 - np.exp(-s["time"] / 8.0))

    def all_milli(values: np.ndarray) -> None:
        values *= 1e3

    drifting = [make("a.mcap", 1, drift), make("b.mcap", 2, drift, 1)]
    found = diagnose(edited(drifting, "joint", "effort", all_milli), chain)
    # Without bodies in the URDF neither side is known to be right.
    assert {one.joint for one in found.data} == {1, 2, 3}
    assert found.findings == ()


@pytest.mark.parametrize("edit", [frozen, reversed_sign])
def test_a_broken_position_ends_the_diagnosis(pair: list[Session], chain: Chain, edit: Edit) -> None:
    found = diagnose(edited(pair, "joint", "position", edit), chain)
    assert {(one.channel, one.joint) for one in found.data} == {("position", 2)}
    assert found.findings == ()


def test_causes_of_other_joints_are_still_named_beside_a_dead_sensor(make: Make, chain: Chain) -> None:
    def drift(s: dict[str, np.ndarray]) -> None:
        s["joint"][:, 0] += 0.4 * (1.0 - np.exp(-s["time"] / 8.0))

    drifting = [make("a.mcap", 1, drift), make("b.mcap", 2, drift, 1)]
    found = diagnose(edited(drifting, "joint", "effort", dead), chain)
    assert [(f.cause, f.joints) for f in found.findings] == [("sensor_offset_drift", (1,))]
    assert {(one.channel, one.joint) for one in found.data} == {("joint torque", 3)}


def test_no_healthy_arm_is_learnt_from_a_channel_that_cannot_be_what_it_says(
    pair: list[Session], make: Make, chain: Chain
) -> None:
    healthy = [make("c.mcap", 11), make("d.mcap", 12, None, 1)]
    with pytest.raises(DataError, match=r"two joint torque: .*reversed sign"):
        commission([healthy, edited(pair, "joint", "effort", reversed_sign)], chain)


@pytest.mark.slow
def test_a_dead_sensor_is_left_out_of_the_healthy_arm(pair: list[Session], make: Make, chain: Chain) -> None:
    healthy = [make("c.mcap", 11), make("d.mcap", 12, None, 1)]
    sets = [edited(part, "joint", "effort", dead) for part in (pair, healthy)]
    names = commission(sets, chain).model.names
    assert "Fcl3" not in names
    assert "Fcl2" in names


def test_some_percent_are_no_broken_channel(make: Make, chain: Chain) -> None:
    def worn(s: dict[str, np.ndarray]) -> None:
        s["joint"][:, 1] *= 1.1
        s["motor"][:, 0] *= 1.05
        top = 0.85 * np.abs(s["joint"][:, 1]).max()
        s["joint"][:, 1] = np.clip(s["joint"][:, 1], -top, top)

    sessions = [make("a.mcap", 1, worn), make("b.mcap", 2, worn, 1)]
    assert broken_channels(sessions, chain, SignalSettings()) == ()


def clipped(share: float) -> Edit:
    """Cuts the largest torques of the second joint off, that share of the samples."""

    def edit(values: np.ndarray) -> None:
        np.minimum(values[:, 1], np.quantile(values[:, 1], 1.0 - share), out=values[:, 1])

    return edit


def test_a_motor_torque_clipped_in_much_of_the_motion_is_left_out(pair: list[Session], chain: Chain) -> None:
    bad, doubts = screened(edited(pair, "motor", "effort", clipped(0.2)), chain, SignalSettings())
    assert [(one.channel, one.joint, one.session, one.lost) for one in bad] == [
        ("motor torque", 2, name, True) for name in ("a.mcap", "b.mcap")
    ]
    assert all("% of the motion), looks like saturation" in one.what for one in bad)
    assert not worthless(bad)
    assert doubts == ()
    # Of a few samples these alone are left out; it is told.
    bad, doubts = screened(edited(pair, "motor", "effort", clipped(0.02)), chain, SignalSettings())
    assert bad == ()
    assert {(one.channel, one.joints, one.kind) for one in doubts} == {
        ("motor torque", ("two",), "saturation")
    }
    told = in_doubt(doubts, chain)
    assert {(one.channel, one.joint, one.session) for one in told} == {
        ("motor torque", 2, name) for name in ("a.mcap", "b.mcap")
    }


def test_a_clipped_motor_torque_alone_on_its_side_is_data(pair: list[Session], chain: Chain) -> None:
    """No row of the joint is left, and its parameters are in columns of rounding errors."""
    empty = np.zeros((len(pair[0].joint), 0))
    motors = [replace(one, joint=replace(one.joint, effort=empty)) for one in pair]
    found = diagnose(edited(motors, "motor", "effort", clipped(0.2)), chain)
    assert {(one.channel, one.joint) for one in found.data} == {("motor torque", 2)}
    assert found.unexplained == ()
    assert np.all(np.isfinite(found.extended_model.values))


def test_an_error_of_the_fit_is_blamed_on_the_broken_channel(pair: list[Session], chain: Chain) -> None:
    bad = broken_channels(edited(pair, "motor", "effort", milli), chain, SignalSettings())
    with pytest.raises(DataError, match=r"two motor torque: .*mNm"), blamed(bad, chain.joint_names):
        raise DataError("singular")
    with pytest.raises(DataError, match="singular"), blamed((), chain.joint_names):
        raise DataError("singular")


@pytest.mark.parametrize(
    ("side", "edit"), [("motor", dead), ("joint", dead), ("motor", swapped), ("joint", milli)]
)
def test_the_models_of_a_diagnosis_with_lost_rows_are_written_and_read(
    pair: list[Session], chain: Chain, side: str, edit: Edit, tmp_path: Path
) -> None:
    found = diagnose(edited(pair, side, "effort", edit), chain)
    lost = {"motor": "Ia", "joint": "Fcl"}[side]
    gone = {f"{lost}{one.joint}" for one in found.data}
    for name, model in (("base", found.base_model), ("extended", found.extended_model)):
        write_model(model, tmp_path / f"{name}.yaml")
        read = read_model(tmp_path / f"{name}.yaml")
        assert read.names == model.names
        assert not gone & set(read.names)
        assert read.std is not None
        assert np.all(np.isfinite(read.std) & (read.std > 0.0))
