"""Wrong channels are named, healthy ones are not: synthetic sessions of an arm that obeys the equations."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.wrong_channels import (
    clipped,
    constant,
    drifting,
    from_the_middle,
    frozen,
    in_one,
    labelled,
    mistaken,
    paced,
    scaled,
    shifted,
    swapped,
    turned,
    with_speed,
    without,
)
from fri.errors import DataError
from ident.dynamics.kinematics import Chain
from ident.dynamics.regressor import torque
from ident.rows.content import Recall
from ident.rows.filters import SignalSettings
from ident.screening.channels import check_channels
from ident.screening.doubts import Doubt, explaining, late_positions, settle
from ident.screening.explanations import unit_of
from ident.screening.limits import check_limits
from ident.screening.positions import position_errors
from ident.screening.screen import _in_bands, require_sound, screen, without_dead
from lwr_driver.session import Session
from tests.ident.estimation_arm import Sensors, chain, session
from tests.ident.screening.torque_sessions import TIMES, of_joints

SENSORS = Sensors(position=2e-5, joint=0.03, motor=0.1, motor_step_s=0.012)


@pytest.fixture(scope="module")
def pair() -> list[Session]:
    bare = session(sensors=SENSORS, seed=1, command=True, metadata={"uid": "one"})
    loaded = session(
        sensors=SENSORS, seed=2, loaded=True, motion_seed=6, command=True, metadata={"uid": "two"}
    )
    return [bare, loaded]


def doubts(sessions: list[Session]) -> tuple[Doubt, ...]:
    return screen(sessions, chain())


def test_healthy_sessions_are_not_doubted(pair: list[Session]) -> None:
    assert doubts(pair) == ()
    assert doubts(pair[:1]) == ()
    for channel in ("motor", "joint"):
        assert doubts(without(channel, lambda sessions: sessions)(pair)) == ()


def test_a_late_motor_channel_is_not_a_wrong_one() -> None:
    late = session(sensors=replace(SENSORS, motor_delay_s=0.02))
    assert doubts([late]) == ()


@pytest.mark.parametrize(
    ("change", "channel", "joints", "words"),
    [
        (scaled("motor", "effort", -1.0, "A5"), "motor torque", ("A5",), "reversed sign"),
        (scaled("joint", "effort", 1e3, "A6"), "joint torque", ("A6",), "mNm"),
        (swapped("motor", "effort", "E1", "A3"), "motor torque", ("E1", "A3"), "interchanged"),
        (swapped("joint", "effort", "A5", "A6"), "joint torque", ("A5", "A6"), "interchanged"),
        (scaled("joint", "position", -1.0, "E1"), "position", ("E1",), "reversed sign"),
        (swapped("joint", "position", "A3", "A4"), "position", ("A3", "A4"), "interchanged"),
        (scaled("joint", "position", 180.0 / np.pi, "A4"), "position", ("A4",), "degrees"),
        (paced(0.5), "time", (), "as fast in the stamps"),
        (labelled("none", "none"), "payload", (), "payload"),
    ],
)  # fmt: skip
def test_a_wrong_channel_is_an_error_with_its_name(pair, change, channel, joints, words) -> None:  # type: ignore[no-untyped-def]
    found = [doubt for doubt in doubts(change(pair)) if doubt.certain]
    assert (found[0].channel, found[0].joints) == (channel, joints)
    assert words in str(found[0])


def test_a_position_in_another_unit_says_nothing_of_the_time(pair: list[Session]) -> None:
    degrees = scaled("joint", "position", 180.0 / np.pi, "A4")(pair[:1])
    assert [(doubt.channel, doubt.joints) for doubt in check_limits(degrees, chain())] == [
        ("position", ("A4",))
    ]
    assert "time" in {doubt.channel for doubt in check_limits(paced(0.05)(degrees), chain())}


M, L = ("motor", "effort"), ("joint", "effort")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "side", "joints", "words", "certain", "where"),
    [
        (in_one(scaled(*M, -1.0, "A2"), 1), "motor", ("A2",), "reversed sign", True, 1),
        (in_one(scaled(*L, 1e-3, "A3")), "joint", ("A3",), "kNm", True, 0),
        (in_one(scaled(*L, 1.4, "A4"), 1), "joint", ("A4",), "a gain of 1.39", False, 1),
        (in_one(swapped(*M, "A3", "A4"), 1), "motor", ("A3", "A4"), "interchanged", True, 1),
        (in_one(shifted(*L, 20.0, "A2")), "joint", ("A2",), "another zero", False, None),
        (from_the_middle(*M, scaled(*M, -1.0, "A4")), "motor", ("A4",), "second half", True, 0),
        (from_the_middle(*L, scaled(*L, 0.7, "A2")), "joint", ("A2",), "second half", False, 0),
        (in_one(drifting(*L, -15.0, "A2"), 1), "joint", ("A2",), "falls by 13", False, 1),
        (in_one(scaled(*L, 0.87, "A2"), 1), "joint", ("A2",), "a gain of 0.8", False, 1),
    ],
)
def test_a_torque_wrong_in_a_part_of_the_data_is_named_with_it(  # type: ignore[no-untyped-def]
    pair, change, side, joints, words, certain, where
) -> None:
    (found,) = doubts(change(pair))
    assert (found.channel, found.joints, found.certain) == (f"{side} torque", joints, certain)
    assert words in str(found)
    # Which of two sessions has the right zero cannot be told.
    if where is not None:
        assert found.session.startswith(pair[where].path.name)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("label", "mass", "wrong"),
    [("none", None, ("loaded",)), ("box", 3.2, ("unloaded",)), ("box", None, ("loaded", "unloaded"))],
)
def test_of_two_sessions_with_one_label_the_weight_tells_the_wrong_one_or_both_are_named(
    label: str, mass: float | None, wrong: tuple[str, ...], pair: list[Session]
) -> None:
    # The wrong one may come first or last.
    for order in (pair, pair[::-1]):
        bare = [replace(session, motor=None) for session in order]
        (found,) = doubts(labelled(label, label, mass=mass)(bare))
        assert (found.channel, found.certain) == ("payload", True)
        named = {name for name in ("loaded", "unloaded") if f"--payload {name}.mcap=NAME" in found.mend}
        assert named == set(wrong)
        assert found.session == (f"{wrong[0]}.mcap" if len(wrong) == 1 else "")
        if len(wrong) == 2:
            assert (
                "one of loaded.mcap, unloaded.mcap carries another payload than its label 'box'" in found.seen
            )


def test_a_torque_that_drifts_in_each_session_is_named_in_all_of_them(pair: list[Session]) -> None:
    (found,) = doubts(drifting(*M, 10.0, "A3")(pair))
    assert (found.channel, found.joints, found.session) == ("motor torque", ("A3",), "all sessions")
    assert "rises by" in found.seen


@pytest.mark.slow
@pytest.mark.parametrize(("number", "degrees", "joint"), [(0, 12.0, "A2"), (1, 8.0, "E1"), (1, -15.0, "A3")])
def test_another_zero_of_a_position_is_named_in_its_session(
    pair: list[Session], number: int, degrees: float, joint: str
) -> None:
    (found,) = doubts(in_one(turned(degrees, joint), number)(pair))
    assert (found.channel, found.joints, found.session) == ("position", (joint,), pair[number].path.name)
    told = float(found.looks_like.removeprefix("a zero offset of ").split()[0])
    assert told == pytest.approx(degrees, rel=0.1)


def test_the_torque_of_a_joint_at_rest_has_no_part(pair: list[Session]) -> None:
    """Its friction is any up to the Coulomb torque. A joint that hardly moves at all keeps its rows."""

    def fit(share: float, more: float) -> dict[tuple[str, int], float]:
        joint = pair[0].joint
        position, effort, first = (
            joint.position.copy(),
            joint.effort.copy(),
            round(share * len(joint.position)),
        )
        position[first:, 5] = position[first, 5]
        effort[first + round(3.0 / joint.period_s) :, 5] += more
        resting = replace(pair[0], joint=replace(joint, position=position, effort=effort), motor=None)
        data = next(iter(_in_bands([resting], chain(), SignalSettings(), (), Recall())))
        return dict(data.fit().rho)

    assert fit(0.5, 20.0) == pytest.approx(fit(0.5, 0.0), rel=1e-6)
    assert fit(0.05, 20.0)["joint", 5] != pytest.approx(fit(0.05, 0.0)["joint", 5], rel=1e-3)


@pytest.mark.parametrize("side", ["motor", "joint"])
def test_the_reversed_side_is_told_from_the_right_one(pair: list[Session], side: str) -> None:
    """All torques of one side reversed: inertia and friction of the other side are positive."""
    (found,) = doubts(scaled(side, "effort", -1.0)(pair))
    assert (found.channel, found.certain, len(found.joints)) == (f"{side} torque", True, 7)


@pytest.mark.parametrize("side", ["motor", "joint"])
def test_the_reversed_side_of_the_last_joint_is_told_by_its_drive(pair: list[Session], side: str) -> None:
    """No other torque tells the sign of the last one's; the friction of its drive does."""
    (found,) = doubts(scaled(side, "effort", -1.0, "A6")(pair))
    assert (found.channel, found.joints, found.certain) == (f"{side} torque", ("A6",), True)


def test_both_sides_reversed_make_a_negative_inertia(pair: list[Session]) -> None:
    both = scaled("motor", "effort", -1.0)(scaled("joint", "effort", -1.0)(pair))
    assert any(doubt.certain and "negative" in doubt.seen for doubt in doubts(both))


@pytest.mark.slow
@pytest.mark.parametrize("up", [(1, 0, 0), (0, -1, 0), (0, 0, -1)])
def test_an_arm_on_a_wall_or_a_ceiling_is_told_by_its_gravity(
    pair: list[Session], up: tuple[int, int, int]
) -> None:
    """The data are of an upright arm; the chain is of the same arm with its base turned in the gravity."""
    turned = replace(chain(), gravity=-9.81 * np.array(up, dtype=float))
    for sessions in (pair, without("motor", lambda logs: logs)(pair)):
        found = screen(sessions, turned)
        assert (found[0].channel, found[0].certain) == ("mounting", True)
        assert "gravity along [0, 0, -1]" in str(found[0])


@pytest.mark.parametrize(
    ("side", "joint", "gain"), [("joint", "A2", 1.3), ("joint", "A3", 0.7), ("motor", "A2", 1.3)]
)
def test_a_gain_is_a_warning_with_its_value(pair: list[Session], side: str, joint: str, gain: float) -> None:
    (found,) = doubts(scaled(side, "effort", gain, joint)(pair))
    assert (found.channel, found.joints, found.certain) == (f"{side} torque", (joint,), False)
    value = float(found.seen.split()[1])
    assert value == pytest.approx(gain, rel=0.05)


def test_one_side_alone_shows_a_gain_and_a_sign(pair: list[Session]) -> None:
    for side, other in (("joint", "motor"), ("motor", "joint")):
        (gain,) = doubts(without(other, scaled(side, "effort", 1.3, "A2"))(pair))
        assert (gain.channel, gain.joints) == (f"{side} torque", ("A2",))
        (sign,) = doubts(without(other, scaled(side, "effort", -1.0, "A3"))(pair))
        assert (sign.joints, sign.certain) == (("A3",), True)


def test_motor_torques_that_pass_for_joint_torques_show_by_the_inertia_of_the_drives(
    pair: list[Session],
) -> None:
    (doubt,) = doubts(mistaken(pair))
    assert (doubt.channel, doubt.looks_like, doubt.certain) == ("joint torque", "motor torques", False)
    assert "`--torque motor`" in doubt.mend
    assert "A3" in doubt.seen
    assert "`motor_torque`" in doubt.mend
    assert doubts(without("motor", lambda sessions: sessions)(pair)) == ()


def test_a_gain_of_a_light_wrist_is_no_matter_of_bodies_without_measure(pair: list[Session]) -> None:
    """Bodies of a hundred times the URDF's weight would explain it as well."""
    (gain,) = doubts(without("motor", scaled("joint", "effort", 1.3, "A5"))(pair[:1]))
    assert (gain.channel, gain.joints) == ("joint torque", ("A5",))
    assert float(gain.seen.split()[1]) == pytest.approx(1.3, rel=0.03)


def test_the_sign_of_a_single_joint_shows_by_its_inertia() -> None:
    time = TIMES[:, None]
    q = np.sin(1.1 * time) + 0.4 * np.sin(2.3 * time + 1.0)
    qd = np.gradient(q, 0.004, axis=0)
    effort = 3.0 * np.gradient(qd, 0.004, axis=0) + 20.0 * np.cos(q) + 4.0 * qd + 5.0 * np.sign(qd)
    alone = Chain.from_table([{"name": "J1"}], gravity=(0.0, -9.81, 0.0))
    assert screen([of_joints(q, effort)], alone) == ()
    (found,) = screen([of_joints(q, -effort)], alone)
    assert found.certain
    assert "negative" in found.seen


@pytest.mark.parametrize(("rubs", "certain"), [(2.0, True), (0.0, False)])
def test_the_sign_of_a_joint_that_shares_nothing_with_the_others_shows_by_its_inertia(
    rubs: float, certain: bool
) -> None:
    """A spindle along a vertical axis and a column that turns about it."""
    time, phase = TIMES[:, None], np.array([0.0, 2.0])
    q = np.sin(1.1 * time + phase) + 0.4 * np.sin(2.3 * time + phase)
    qd = np.gradient(q, 0.004, axis=0)
    effort = np.array([5.0, 8.0]) * np.gradient(qd, 0.004, axis=0) + [0.0, 8.0 * 9.81]
    effort += rubs * np.sign(qd)
    arm = Chain.from_table([{"name": "J1"}, {"name": "J2", "kind": "prismatic"}], gravity=(0.0, 0.0, -9.81))
    assert screen([of_joints(q, effort)], arm) == ()
    (found,) = screen([of_joints(q, effort * [1.0, -1.0])], arm)
    assert (found.channel, found.joints, found.certain) == ("joint torque", ("J2",), certain)
    assert "its inertia is negative (-8" in found.seen
    assert "kg)" in found.seen


PLANAR = """<robot name="planar"><link name="base"/>
  <joint name="J1" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" velocity="5" effort="200"/></joint>
  <link name="upper"><inertial><origin xyz="0.2 0.01 0"/><mass value="6"/>
    <inertia ixx="0.02" iyy="0.09" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="J2" type="revolute"><parent link="upper"/><child link="fore"/><origin xyz="0.4 0 0"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" velocity="5" effort="200"/></joint>
  <link name="fore"><inertial><origin xyz="0.15 -0.01 0"/><mass value="4"/>
    <inertia ixx="0.01" iyy="0.05" izz="0.05" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""


@pytest.mark.parametrize(
    ("gains", "joints"),
    [((1.0, 1.3), ("J2", "J1")), ((0.77, 1.0), ("J1", "J2")), ((1.0, 2.2), ("J2",)), ((0.45, 1.0), ("J1",))],
)
def test_of_two_gains_that_fit_alike_the_bodies_of_the_urdf_tell_the_likelier(
    gains: tuple[float, float], joints: tuple[str, ...]
) -> None:
    """Two parallel vertical axes: the second torque too large, or the first too small."""
    arm, time, phase = Chain.from_urdf(PLANAR), TIMES[:, None], np.array([0.0, 2.0])
    q = np.sin(1.7 * time + phase) + 0.6 * np.sin(3.1 * time + phase)
    qd = np.gradient(q, 0.004, axis=0)
    bodies = arm.urdf_inertials() * [[1.06], [0.94]]
    effort = torque(arm, q, qd, np.gradient(qd, 0.004, axis=0), bodies)
    assert screen([of_joints(q, effort)], arm) == ()
    (found,) = screen([of_joints(q, effort * gains)], arm)
    assert (found.channel, found.joints) == ("joint torque", joints)
    listed = dict(re.findall(r"(J\d) is (\S+) times", found.seen)) or {joints[0]: found.seen.split()[1]}
    right = 1 if gains[0] == 1.0 else 0
    assert float(listed[f"J{right + 1}"]) == pytest.approx(gains[right], rel=0.03)


def test_channels_that_contradict_themselves_are_named(pair: list[Session]) -> None:
    def found(change) -> Doubt:  # type: ignore[no-untyped-def]
        return check_channels(change(pair), chain())[0]

    assert found(constant("joint", "position", 0.4, "A5")).certain
    assert found(constant("joint", "effort", 0.0, "A4")).joints == ("A4",)
    assert "saturation" in found(clipped("joint", "effort", 0.7, "A2")).looks_like
    assert "saturation" in found(clipped("motor", "effort", 0.5, "A3")).looks_like
    assert found(clipped("joint", "position", 0.7, "A4")).channel == "position"
    assert found(paced(2.0, clocks=("publish_time",))).channel == "time"
    assert found(paced(1e3)).channel == "time"
    velocity = found(with_speed(None, -1.0, "A3"))
    assert (velocity.channel, velocity.joints) == ("velocity", ("A3",))
    units = found(with_speed(None, 180.0 / np.pi, *chain().joint_names))
    assert (units.channel, units.certain) == ("velocity", False)
    assert check_channels(with_speed()(pair), chain()) == []
    assert check_channels([], chain()) == []


@pytest.mark.parametrize("side", ["joint", "motor"])
def test_a_torque_that_is_a_copy_of_another_joints_is_an_error(pair: list[Session], side: str) -> None:
    columns = getattr(pair[1], side)
    effort = columns.effort.copy()
    effort[:, 4] = effort[:, 2]
    copied = replace(pair[1], **{side: replace(columns, effort=effort)})
    (found,) = screen([pair[0], copied], chain())
    assert (found.channel, found.joints, found.session) == (f"{side} torque", ("E1", "A4"), "loaded.mcap")
    assert found.certain
    effort[:, 4] = np.round(effort[:, 2], 3)
    rounded = check_channels([replace(pair[1], **{side: replace(columns, effort=effort)})], chain())
    assert [doubt.joints for doubt in rounded] == [found.joints]
    # Two dead sensors are no copies, nor are torques equal but for one sample.
    effort[17, 4] += 0.01 * np.ptp(effort[:, 4])
    assert screen([pair[0], replace(pair[1], **{side: replace(columns, effort=effort)})], chain()) != (found,)
    effort[:, [2, 4]] = 0.0
    silent = check_channels([replace(pair[1], **{side: replace(columns, effort=effort)})], chain())
    assert {doubt.looks_like for doubt in silent} == {"a dead sensor"}


@pytest.mark.parametrize("side", ["joint", "motor"])
def test_a_torque_that_is_a_copy_for_a_part_of_a_session_is_told_with_its_time(
    pair: list[Session], side: str
) -> None:
    columns = getattr(pair[1], side)
    half = len(columns.effort) // 2

    def seen(effort: np.ndarray) -> list[Doubt]:
        changed = replace(pair[1], **{side: replace(columns, effort=effort)})
        return [
            doubt for doubt in check_channels([pair[0], changed], chain()) if "column" in doubt.looks_like
        ]

    effort = columns.effort.copy()
    effort[half:, 2] = effort[half:, 3]
    effort[:half, 5] = effort[:half, 6] = effort[:half, 0]
    found = {doubt.joints: doubt for doubt in seen(effort)}
    assert set(found) == {("E1", "A3"), ("A1", "A5", "A6")}
    start = (columns.log_time[half] - pair[1].joint.log_time[0]) * 1e-9
    assert f"read the same to the last bit from {start:.1f} to " in found["E1", "A3"].seen
    assert all(one.certain and one.session == "loaded.mcap" for one in found.values())
    # Columns at rest, dead, held for long or equal for a moment are no copies.
    for rest in (0.0, np.repeat(np.arange(10.0), len(effort) // 10 + 1)[: len(effort) - half]):
        effort = columns.effort.copy()
        effort[half:, 2] = effort[half:, 3] = rest
        assert not seen(effort)
    effort = columns.effort.copy()
    some = slice(half, half + int(0.09 * len(effort)))
    effort[some, 2] = effort[some, 3]
    assert not seen(effort)


def test_positions_that_are_a_copy_of_another_joints_are_told(pair: list[Session]) -> None:
    columns = pair[1].joint
    position = columns.position.copy()
    position[:, 4] = position[:, 2]
    copied = replace(pair[1], joint=replace(columns, position=position))
    (found,) = [d for d in check_channels([pair[0], copied], chain()) if "column" in d.looks_like]
    assert (found.channel, found.joints, found.session) == ("position", ("E1", "A4"), "loaded.mcap")
    # The commands ask for different motions; without commands a simulation may have them alike.
    assert found.certain
    (found,) = [
        d for d in check_channels([replace(copied, command=None)], chain()) if "column" in d.looks_like
    ]
    assert not found.certain
    command = pair[1].command
    assert command is not None
    asked = command.position.copy()
    asked[:, 4] = asked[:, 2]
    same = replace(copied, command=replace(command, position=asked))
    assert not [d for d in check_channels([same], chain()) if "column" in d.looks_like]


def late(session: Session, place: int, size: float) -> Session:
    """Positions of a joint (from 0) late by `size` [s]."""
    position = session.joint.position.copy()
    time = np.arange(len(position)) * session.joint.period_s
    position[:, place] = np.interp(time - size, time, position[:, place])
    return replace(session, joint=replace(session.joint, position=position))


@pytest.mark.parametrize(
    ("name", "kind", "size"),
    [
        ("E1", "offset", np.radians(5.0)),
        ("A3", "offset", np.radians(-6.0)),
        ("A2", "gain", 0.15),
        ("A4", "gain", -0.15),
        ("A2", "delay", 0.04),
        ("A3", "delay", 0.016),
    ],
)
def test_a_position_with_a_small_error_is_told_with_its_size(
    pair: list[Session], name: str, kind: str, size: float
) -> None:
    place = chain().joint_names.index(name)

    def edited(session: Session) -> Session:
        if kind == "delay":
            return late(session, place, size)
        position = session.joint.position.copy()
        own = position[:, place]
        position[:, place] = own + size if kind == "offset" else (1.0 + size) * own
        return replace(session, joint=replace(session.joint, position=position))

    data = next(_in_bands([edited(session) for session in pair], chain(), SignalSettings(), (), Recall()))
    normal = data.normal()
    (found,) = position_errors(data, data.fit(normal), normal)
    assert (chain().joint_names[found.joint], found.kind) == (name, kind)
    assert found.size == pytest.approx(size, abs=max(0.2 * abs(size), 3.0 * found.std))


def test_late_positions_show_in_motor_torques_alone(pair: list[Session]) -> None:
    sessions = without("joint", lambda sessions: [late(one, 3, 0.02) for one in sessions])(pair)
    (found,) = screen(sessions, chain())
    assert (found.channel, found.joints) == ("position", ("A3",))
    assert "looks like positions 20 ± " in str(found)
    assert late_positions([found])


def test_positions_that_come_after_their_velocities_are_told(pair: list[Session]) -> None:
    whole = with_speed()(pair[:1])
    (found,) = check_channels([late(whole[0], 3, 0.02)], chain())
    assert (found.channel, found.joints) == ("position", ("A3",))
    assert re.match(r"comes 2[01] ± [\d.]+ ms after its velocity", found.seen)
    # A velocity late by its filter has no part in the rows.
    joint = whole[0].joint
    filtered = replace(joint, velocity=np.roll(joint.velocity, 8, axis=0))
    assert check_channels([replace(whole[0], joint=filtered)], chain()) == []


def test_positions_of_a_healthy_arm_have_no_small_error(pair: list[Session]) -> None:
    data = next(_in_bands(pair, chain(), SignalSettings(), (), Recall()))
    normal = data.normal()
    assert position_errors(data, data.fit(normal), normal) == []


@pytest.mark.parametrize(
    ("channel", "field", "name"),
    [
        ("motor", "effort", "motor torque"),
        ("joint", "effort", "joint torque"),
        ("joint", "position", "position"),
    ],
)
def test_a_channel_frozen_in_the_middle_of_a_motion_is_named(
    pair: list[Session], channel: str, field: str, name: str
) -> None:
    for commanded in (True, False):
        logs = pair if commanded else [replace(session, command=None) for session in pair]
        (found,) = check_channels(in_one(frozen(channel, field, "A3"), 1)(logs), chain())
        assert (found.channel, found.joints, found.session, found.certain) == (
            name,
            ("A3",),
            "loaded.mcap",
            True,
        )
        assert "from 6.5 to 19.5 s" in found.seen
        assert found.lost == (field == "effort")


def stopped(
    session: Session, channel: str, field: str, joints: list[int], *spans: tuple[float, float]
) -> Session:
    """The channel of some joints (from 0) keeps its value in each span: its start and length [s]."""
    columns = getattr(session, channel)
    values = getattr(columns, field).copy()
    seconds = (columns.log_time - session.joint.log_time[0]) * 1e-9
    for start, length in spans:
        at = np.flatnonzero((seconds >= start - 1e-6) & (seconds <= start + length + 1e-6))
        values[np.ix_(at, joints)] = values[at[0], joints]
    return replace(session, **{channel: replace(columns, **{field: values})})


@pytest.mark.parametrize(
    ("seconds", "certain"), [(0.02, None), (0.2, False), (1.0, False), (1.9, True), (2.1, True)]
)
def test_a_short_freeze_is_a_warning_and_a_moment_is_none(
    pair: list[Session], seconds: float, certain: bool | None
) -> None:
    for field in ("effort", "position"):
        one = replace(stopped(pair[0], "joint", field, [1], (8.0, seconds)), command=None)
        found = check_channels([one], chain())
        assert [doubt.certain for doubt in found] == ([] if certain is None else [certain])
        for doubt in found:
            assert doubt.joints == ("A2",)
            assert "from 8.0" in doubt.seen
            assert f"({seconds:.{1 if seconds > 2.0 else 2}f} s), in the middle of a motion" in doubt.seen
            assert ("these samples are left out" in doubt.mend) != certain


def test_short_freezes_are_named_together(pair: list[Session]) -> None:
    spans = [(float(start), 0.2) for start in range(4, 22, 4)]
    (found,) = check_channels([stopped(pair[0], "joint", "effort", [1], *spans)], chain())
    assert (found.channel, found.joints, found.certain) == ("joint torque", ("A2",), False)
    assert "(0.20 s) and 4 more times, 1.00 s in all" in found.seen
    everywhere = list(range(7))
    (found,) = check_channels([stopped(pair[0], "joint", "position", everywhere, (8.0, 0.5))], chain())
    assert (found.channel, found.joints, found.certain) == ("position", chain().joint_names, False)
    assert "keep their values from 8.00 to 8.50 s (0.50 s)" in found.seen
    for side in ("joint", "motor"):
        (found,) = check_channels([stopped(pair[0], side, "effort", everywhere, (8.0, 1.0))], chain())
        assert (found.channel, found.joints, found.certain) == (f"{side} torque", (), False)
        assert "every joint keeps its value" in found.seen


def test_samples_of_a_short_freeze_have_no_part_in_the_rows(pair: list[Session]) -> None:
    from ident.rows.prepare import prepare

    whole = replace(pair[0], command=None)
    for field, count in (("position", "position_frozen"), ("effort", "joint_torque_frozen")):
        one = stopped(whole, "joint", field, [1], (10.0, 0.4))
        prepared, before = prepare(one, advise=False), prepare(whole, advise=False)
        assert (prepared.counts[count], before.counts[count]) == (100, 0)
        assert prepared.counts["stretches"] == (2 if field == "position" else 1)
        for passage in prepared.passages:
            known = passage.joint.known[(passage.joint.times > 10.0) & (passage.joint.times < 10.4)]
            assert not known[:, 1].any()
            # The other torques are good where the positions are.
            assert known[:, 0].any() == (field == "effort")
        reach = [np.abs(passage.joint.qdd).max() for passage in (*prepared.passages, *before.passages)]
        assert max(reach) < 1.1 * reach[-1]
    motor = prepare(stopped(whole, "motor", "effort", [1], (10.0, 1.0)), advise=False).passages[0].motor
    assert motor is not None
    assert not motor.known[(motor.times > 10.05) & (motor.times < 10.95), 1].any()


def test_a_position_that_halts_at_once_while_others_move_is_frozen(pair: list[Session]) -> None:
    """The joint comes back to where it froze, or stays frozen until the end; a brake is no frozen position."""
    whole = replace(pair[0], command=None)
    position, period = whole.joint.position, whole.joint.period_s
    count = len(position)
    speed = np.abs(position[50:] - position[:-50]) / (50 * period)
    joint = 2
    first = int(np.argmax(speed[: count // 2, joint])) + 25
    back = (
        first
        + 75
        + int(np.argmin(np.abs(position[first + 75 : first + 500, joint] - position[first, joint])))
    )
    assert np.ptp(position[first:back, joint]) > 0.3
    assert abs(position[back, joint] - position[first, joint]) < 0.005
    for last in (back, count):
        still = position.copy()
        still[first:last, joint] = still[first, joint]
        frozen_log = replace(whole, joint=replace(whole.joint, position=still))
        found = [d for d in check_channels([frozen_log], chain()) if d.channel == "position"]
        assert [(d.joints, d.looks_like) for d in found] == [(("E1",), "a frozen channel")]
    # Speed falls to nothing in a tenth of a second, and rises again as fast.
    time = np.arange(count) * period
    rate = np.gradient(position[:, joint], period)
    rate *= np.clip(np.abs(time - time[first] - 0.5) / 0.1 - 4.0, 0.0, 1.0)
    braked = position.copy()
    braked[:, joint] = np.cumsum(rate) * period
    assert check_channels([replace(whole, joint=replace(whole.joint, position=braked))], chain()) == []


def test_positions_that_no_jump_follows_are_not_frozen(pair: list[Session]) -> None:
    whole = replace(pair[0], command=None)
    columns, position = whole.joint, whole.joint.position

    def jumps(position: np.ndarray, **times: np.ndarray) -> list[Doubt]:
        joint = replace(columns, position=position, **times)  # type: ignore[arg-type]
        return [d for d in check_channels([replace(whole, joint=joint)], chain()) if d.channel == "position"]

    count = len(position)
    # An encoder of 9 bits, a channel ten times slower than its stamps, samples repeated by a network.
    grain = 2.0 * np.pi / 512.0
    assert jumps(np.round(position / grain) * grain) == []
    assert jumps(position[np.arange(count) // 10 * 10]) == []
    repeated = np.random.default_rng(3).random(count) < 0.1
    assert jumps(position[np.maximum.accumulate(np.where(repeated, 0, np.arange(count)))]) == []
    # Stop and go, with a rest of half a second in each of two seconds.
    time = np.arange(count) * columns.period_s
    phase = np.clip((time % 2.0) / 1.5, 0.0, 1.0)
    go = (phase**3 * (10.0 - 15.0 * phase + 6.0 * phase**2)) * np.where(time // 2.0 % 2.0, -1.0, 1.0)
    go += np.where(time // 2.0 % 2.0, 1.0, 0.0)
    assert jumps(np.tile(go[:, None], 7)) == []
    # A recording that paused while the arm went elsewhere.
    paused = np.where(time[:, None] < 10.0, position[0], position)
    late = columns.log_time + np.where(time < 10.0, 0, 20_000_000_000)
    assert jumps(paused, log_time=late, publish_time=late) == []


def test_dead_zones_coarse_sensors_and_resting_joints_are_not_frozen(pair: list[Session]) -> None:
    whole = pair[0]

    def frozen_ones(session: Session) -> list[Doubt]:
        return [doubt for doubt in check_channels([session], chain()) if "frozen" in doubt.looks_like]

    coarse = np.round(whole.joint.effort / 4.0) * 4.0
    assert frozen_ones(replace(whole, joint=replace(whole.joint, effort=coarse))) == []
    assert whole.motor is not None
    effort = whole.motor.effort.copy()
    effort[np.abs(effort) < 6.0] = 0.0
    assert frozen_ones(replace(whole, motor=replace(whole.motor, effort=effort))) == []
    time = (whole.joint.log_time - whole.joint.log_time[0]) * 1e-9
    position = whole.joint.position.copy()
    swing = 0.5 * (1.0 - np.cos(1.0 * np.clip(time, 0.0, 2.0 * np.pi)))
    position[:, 2] = 0.3 + swing + 0.5 * (1.0 - np.cos(np.clip(time - 15.0, 0.0, 2.0 * np.pi)))
    resting = replace(whole, joint=replace(whole.joint, position=position), command=None)
    assert frozen_ones(resting) == []
    stopped = position.copy()
    stopped[(time > 2.0) & (time < 9.0), 2] = position[np.searchsorted(time, 2.0), 2]
    assert [
        d.joints
        for d in frozen_ones(replace(whole, joint=replace(whole.joint, position=stopped), command=None))
    ] == [("E1",)]


def test_a_log_given_twice_is_known_by_uid_and_by_content(pair: list[Session]) -> None:
    copy = replace(pair[0], path=Path("copy.mcap"), metadata={**pair[0].metadata, "uid": "three"})
    for sessions in ([pair[0], pair[0]], [pair[0], copy]):
        with pytest.raises(DataError, match="given twice"):
            require_sound(sessions, chain())


def test_two_recordings_with_one_uid_are_both_used(pair: list[Session]) -> None:
    other = replace(pair[1], metadata={**pair[1].metadata, "uid": pair[0].metadata["uid"]})
    (told,) = require_sound([pair[0], other], chain())
    assert f"hold different samples and the uid {pair[0].metadata['uid']}" in str(told)
    assert "two recordings may stay" in str(told)


def test_rows_of_a_sensor_dead_in_one_session_are_left_out(pair: list[Session]) -> None:
    from ident.dynamics.structure import ModelStructure
    from ident.rows.observation import observe
    from ident.rows.prepare import prepare

    bad = in_one(constant("joint", "effort", 0.0, "A4"))(pair)
    (found,) = screen(bad, chain())
    assert not found.certain
    rows = observe([prepare(bad[0])], [None], ModelStructure(chain()))
    kept = without_dead(rows, bad[0])
    assert {group.label for group in rows.groups} - {group.label for group in kept.groups} == {"A4 joint"}
    assert without_dead(rows, pair[0]).groups == rows.groups


def with_masses(factor: float) -> Chain:
    """The arm with all inertials of its URDF times a factor."""
    text = chain().urdf
    assert text is not None
    for name in ("value", "ixx", "ixy", "ixz", "iyy", "iyz", "izz"):
        tag = "mass" if name == "value" else "inertia"
        text = re.sub(
            rf'(<{tag}[^>]*\b{name}=")([^"]*)"', lambda m: f'{m[1]}{factor * float(m[2]):.9g}"', text
        )
    return Chain.from_urdf(text)


def test_masses_of_no_arm_are_a_warning_and_torques_in_another_unit_an_error(pair: list[Session]) -> None:
    light = with_masses(2e-3)
    (found,) = screen(pair, light)
    assert not found.certain
    assert "looks like placeholders: the URDF gives all links together 0.0" in str(found)
    assert "manufacturer's masses" in found.mend
    assert not chain().placeholder_masses()

    def measured(factor: float) -> list[Session]:
        return scaled("joint", "effort", factor)(scaled("motor", "effort", factor)(pair))

    assert any(doubt.certain and "mNm" in doubt.looks_like for doubt in screen(measured(1e3), chain()))
    # The sign says more than the size.
    assert any(doubt.certain for doubt in screen(measured(-1.0), light))


def test_masses_look_like_no_arms_by_their_sameness_the_reach_and_the_torques() -> None:
    def said(factor: float, lengths: float) -> str:
        arm = with_masses(factor)
        return replace(arm, r=lengths * arm.r).placeholder_masses()

    assert "together 0.869 kg, for a reach of 1.1 m" in said(0.05, 1.0)
    assert not said(0.06, 1.0)
    # A small arm may be light, yet not beside torques of 176 Nm.
    assert "for torques up to 176 Nm" in said(0.05, 0.2)
    same = re.sub(r'<mass value="[^"]*"', '<mass value="2"', chain().urdf or "")
    assert "every link the same mass (2 kg)" in Chain.from_urdf(same).placeholder_masses()


def test_a_message_says_channel_joint_sight_guess_and_remedy() -> None:
    doubt = Doubt(
        "motor torque", ("A5",), "is -1 times the other", "a reversed sign", "check it", session="a.mcap"
    )
    assert (
        str(doubt) == "a.mcap: A5 motor torque: is -1 times the other, looks like a reversed sign; check it"
    )
    assert settle([doubt]) == [str(doubt)]
    with pytest.raises(DataError, match="reversed sign"):
        settle([doubt, replace(doubt, certain=True)])


@pytest.mark.parametrize(
    ("factor", "words"),
    [(1000.0, "mNm"), (0.001, "kNm"), (57.3, "degrees"), (-1.0, "a reversed sign"), (1.3, "a gain of 1.3")],
)
def test_factors_have_their_usual_causes(factor: float, words: str) -> None:
    assert words in unit_of(factor)


def test_a_torque_is_no_angle() -> None:
    assert unit_of(57.3, torque=True) == "a gain of 57.3"
    assert "mNm" in unit_of(1000.0, torque=True)


def jumping(where: Session, joint: int, size: float, sample: int = 2000) -> Session:
    position = where.joint.position.copy()
    position[sample:, joint] += size
    return replace(where, joint=replace(where.joint, position=position))


def test_a_position_that_jumps_is_told_with_time_size_and_advice(pair: list[Session]) -> None:
    bare = replace(pair[0], command=None)
    (turn,) = check_channels([jumping(bare, 4, -2.0 * np.pi)], chain())
    at = (bare.joint.log_time[2000] - bare.joint.log_time[0]) * 1e-9
    assert not turn.certain
    assert turn.joints == (bare.joint_names[4],)
    assert str(turn).endswith(
        f"jumps by 360 deg in one sample at {at:.4g} s, looks like an angle that wraps; import the recording with "
        "`lwr-run import`, which unwraps it; rows are built on either side only"
    )
    (zeroed,) = check_channels([jumping(jumping(bare, 2, 0.4), 2, -0.1, 2400)], chain())
    assert "jumps by up to 0.399 rad" in zeroed.seen
    assert "and 1 more time" in zeroed.seen
    assert "or a joint zeroed anew" in zeroed.looks_like
    (missing,) = check_channels([jumping(jumping(bare, 2, 0.4), 3, -0.1)], chain())
    assert missing.joints == bare.joint_names[2:4]
    assert missing.looks_like == "samples missing without a gap in the stamps"
    # The velocities are as good as before.
    with_speeds = with_speed()([bare])[0]
    (turn, *more) = check_channels([jumping(with_speeds, 4, -2.0 * np.pi)], chain())
    assert (turn.channel, more) == ("position", [])


def test_velocities_off_by_some_per_cent_in_all_joints_alike_are_told(pair: list[Session]) -> None:
    names = chain().joint_names
    slow = check_channels(with_speed(None, 1.05, *names)(pair[:1]), chain())
    assert [(doubt.channel, doubt.certain) for doubt in slow] == [("time", False)]
    assert slow[0].seen == "the velocities of all joints are 1.05 times dq/dt"
    assert slow[0].looks_like == "stamps that pass 1.05 times too fast, or a wrong scale of the velocities"
    assert check_channels(with_speed(None, 1.02, *names)(pair[:1]), chain()) == []
    assert check_channels(with_speed(None, 1.08, *names[:5])(pair[:1]), chain()) == []


def test_motor_torques_that_are_a_copy_of_the_joint_torques_are_named(pair: list[Session]) -> None:
    joint, motor = pair[0].joint, pair[0].motor
    assert motor is not None
    copied = replace(pair[0], motor=replace(joint, topic=motor.topic))
    (found,) = screen([copied], chain())
    assert (found.channel, found.joints, found.certain) == ("motor torque", chain().joint_names, True)
    assert found.seen == "is the joint torque to four digits in every sample"
    assert "`--model 1`" in found.mend
    # The joint torques are as good as before.
    assert screen([copied], chain(), motor=False) == ()
    effort = joint.effort.copy()
    effort[:, 1:] += 1.0
    (found,) = screen([replace(copied, motor=replace(joint, effort=effort))], chain())
    assert found.joints == chain().joint_names[:1]


def test_an_error_after_a_doubt_says_the_doubt() -> None:
    clipped_torque = Doubt("motor torque", ("A1",), "stays at 24.9 Nm", "saturation", "move more gently")
    said = r"no delay fits\n.*in doubt:\nA1 motor torque: stays at 24.9 Nm"
    with pytest.raises(DataError, match=said), explaining((clipped_torque,)):
        raise DataError("no delay fits")
    with pytest.raises(DataError, match=r"^no delay fits$"), explaining(()):
        raise DataError("no delay fits")
