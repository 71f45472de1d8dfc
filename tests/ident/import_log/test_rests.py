"""Joints beside those of the model: a second arm, a gripper at the end, a head, in tables and in bags."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mcap_ros2.writer import Writer

from fri.errors import ConfigurationError, DataError
from ident.dynamics.session_chain import recorded_rests, session_chain
from ident.dynamics.urdf import read_urdf
from ident.import_log import Known, guess_mapping, read_recording
from ident.import_log.rests import rests, without_gripper
from lwr_driver.session.messages import JOINT_STATE, STRING
from tests.ident.stock_panda import joint, link

N = 300
T = np.arange(N) * 0.01
LEFT, RIGHT = ("left_1", "left_2", "left_3"), ("right_1", "right_2", "right_3")


def robot(*, arms: tuple[str, ...] = ("left", "right"), gripper: bool = False) -> str:
    """Arms of three joints on a lifting torso, each with a gripper of one revolute joint if asked for."""
    parts = [link("base", 9.0), link("torso", 5.0)]
    parts.append(joint("lift", "revolute", "base", "torso", ("0 0 1", "0 0 0")))
    for arm in arms:
        names = ["torso", *(f"{arm}_link{k}" for k in (1, 2, 3)), *([f"{arm}_hand"] if gripper else [])]
        kinds = [f"{arm}_1", f"{arm}_2", f"{arm}_3", f"{arm}_gripper"]
        for name, parent, child in zip(kinds, names, names[1:], strict=False):
            parts += [
                link(child, 1.0),
                joint(name, "revolute", parent, child, ("0 0.1 0.2", "1.5707963 0 0")),
            ]
    return f'<robot name="pair">{"".join(parts)}</robot>'


def swing(names: tuple[str, ...], moving: tuple[str, ...]) -> np.ndarray:
    """Positions (N, k): those named move, the k-th other rests at k / 10."""
    columns = [np.sin(2.0 * T + k) if name in moving else np.full(N, 0.1 * k) for k, name in enumerate(names)]
    return np.column_stack(columns)


def table(path: Path, names: tuple[str, ...], q: np.ndarray) -> Path:
    head = ",".join(["t", *(f"{name}.{what}" for what in ("position", "effort") for name in names)])
    np.savetxt(path, np.column_stack([T, q, 3.0 * q + 1.0]), delimiter=",", header=head, comments="")
    return path


def bag(path: Path, names: tuple[str, ...], q: np.ndarray, description: str | None) -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        state = writer.register_msgdef(JOINT_STATE.name, JOINT_STATE.text)
        text = writer.register_msgdef(STRING.name, STRING.text)
        if description is not None:
            writer.write_message("/robot_description", text, {"data": description}, 1, 1)
        for k, time in enumerate(T):
            stamp = round((1.7e9 + time) * 1e9)
            content = {
                "header": {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": ""},
                "name": list(names),
                "position": q[k].tolist(),
                "velocity": [],
                "effort": (3.0 * q[k] + 1.0).tolist(),
            }
            writer.write_message("/joint_states", state, content, stamp, stamp)
        writer.finish()
    return path


def write_urdf(folder: Path, text: str) -> Path:
    (folder / "arm.urdf").write_text(text)
    return folder / "arm.urdf"


@pytest.mark.parametrize("right_moves", [False, True])
def test_a_second_arm_is_of_no_concern_unless_the_chain_carries_it(right_moves: bool, tmp_path: Path) -> None:
    names = ("lift", *LEFT, *RIGHT)
    q = swing(names, (*LEFT, *(RIGHT if right_moves else ())))
    source, urdf = table(tmp_path / "run.csv", names, q), write_urdf(tmp_path, robot())
    guess = guess_mapping(source, urdf, Known(joints=LEFT))
    assert guess.mapping.joints == LEFT
    assert guess.mapping.held == {"lift": 0.0}
    q[:, 0] = np.cos(T)
    carried = guess_mapping(
        table(tmp_path / "lifted.csv", names, q), urdf, Known(joints=("lift", *LEFT))
    ).mapping.held
    rest = {name: round(float(q[:, k].mean()), 4) for k, name in enumerate(names) if name in RIGHT}
    assert carried == pytest.approx(rest)
    text = str(guess_mapping(tmp_path / "lifted.csv", urdf, Known(joints=("lift", *LEFT))))
    assert ("right_1 ... right_3" in text, "moves, held at its mean" in text) == (True, right_moves)
    with pytest.raises(DataError, match=r"lift moves by .* rad; name it in --joints"):
        guess_mapping(tmp_path / "lifted.csv", urdf, Known(joints=LEFT))


def test_joints_on_the_way_and_carried_ones() -> None:
    read = read_urdf(robot(gripper=True))
    right = {*RIGHT, "right_gripper"}
    assert read.beside(LEFT) == ({"lift", "left_gripper"}, frozenset())
    assert read.beside(LEFT[:2]) == ({"lift", "left_3", "left_gripper"}, frozenset())
    assert read.beside(("lift", *LEFT)) == ({"left_gripper"}, right)
    assert read.beside(LEFT[1:], root="torso") == ({"left_1", "left_gripper"}, frozenset())
    found = rests(Path("a"), ("left_gripper",), np.full((5, 1), 0.25), LEFT, read)
    assert (found.held, found.moving) == ({"left_gripper": 0.25}, ())


@pytest.mark.parametrize("recorded", [3, 4])
def test_a_gripper_of_one_joint_ends_the_arm_if_it_rests_or_is_not_recorded(
    recorded: int, tmp_path: Path
) -> None:
    """The arm is that of the model with numbered columns, too."""
    whole = ("lift", "left_1", "left_2", "left_3", "left_gripper")
    urdf = write_urdf(tmp_path, robot(arms=("left",), gripper=True))
    q = swing(whole, whole[:4])[:, : recorded + 1]
    named = guess_mapping(table(tmp_path / "named.csv", whole[: recorded + 1], q), urdf)
    numbers = tuple(str(k) for k in range(1, recorded + 2))
    numbered = guess_mapping(table(tmp_path / "numbered.csv", numbers, q), urdf)
    for guess in (named, numbered):
        assert guess.mapping.joints == whole[:4]
        assert guess.mapping.held == (None if recorded == 3 else {"left_gripper": 0.4})
        assert ("without the gripper at rest" in str(guess)) == (recorded == 4)
        torque = guess.mapping.joint_torque
        assert torque is not None
        labels = whole[:4] if guess is named else numbers[:4]
        assert torque.columns == tuple(f"{label}.effort" for label in labels)
    if recorded == 4:
        moving = guess_mapping(table(tmp_path / "all.csv", whole, swing(whole, whole)), urdf)
        assert moving.mapping.joints == whole


def test_a_gripper_is_told_by_its_name_and_place() -> None:
    read = read_urdf(robot(arms=("left",), gripper=True))
    assert [one.name for one in read.joints if one.grips] == ["left_gripper"]
    assert read.arm(count=5) == ("lift", *LEFT, "left_gripper")
    assert read.arm(count=4) == ("lift", *LEFT)
    with pytest.raises(ConfigurationError, match=r"no serial arms with 3 joints .*with --joints"):
        read.arm(count=3)
    backwards = ("left_gripper", *LEFT[::-1])
    still = np.zeros((9, 4))
    assert without_gripper(backwards, still, read) == LEFT[::-1]
    assert without_gripper(LEFT, still[:, :3], read) == LEFT


def test_the_joints_of_a_bag_may_be_chosen(tmp_path: Path) -> None:
    names = ("lift", *LEFT, *RIGHT)
    q = swing(names, LEFT)
    path = bag(tmp_path / "one.mcap", names, q, robot())
    log = read_recording(path, joints=LEFT)
    assert (log.joint_names, log.metadata["robot"]) == (LEFT, "pair")
    np.testing.assert_array_equal(log.joint.position, q[:, 1:4])
    np.testing.assert_array_equal(log.joint.effort, 3.0 * q[:, 1:4] + 1.0)
    assert recorded_rests(log.metadata) == {"lift": 0.0}
    assert session_chain(log).joint_names == LEFT
    with pytest.raises(ConfigurationError, match=r"2 serial arms .*with --joints"):
        session_chain(read_recording(path))
    with pytest.raises(ConfigurationError, match="no joint 'left_9'"):
        read_recording(path, joints=("left_9",))


def test_a_bag_has_the_name_of_its_description_or_none(tmp_path: Path) -> None:
    names = ("lift", *LEFT)
    q = swing(names, names)
    bare, described = (
        bag(tmp_path / f"{name}.mcap", names, q, text)
        for name, text in (("monday", None), ("tuesday", robot(arms=("left",))))
    )
    urdf = write_urdf(tmp_path, robot(arms=("left",)))
    logs = [read_recording(bare), read_recording(described), read_recording(bare, urdf=urdf)]
    assert [log.metadata["robot"] for log in logs] == ["", "pair", "pair"]


def test_a_gripper_at_rest_ends_the_arm_of_a_bag(tmp_path: Path) -> None:
    names = ("lift", *LEFT, "left_gripper")
    text = robot(arms=("left",), gripper=True)
    log = read_recording(bag(tmp_path / "a.mcap", names, swing(names, names[:4]), text))
    assert (log.joint_names, recorded_rests(log.metadata)) == (names[:4], {"left_gripper": 0.4})
    moving = read_recording(bag(tmp_path / "b.mcap", names, swing(names, names), text))
    assert set(session_chain(moving).joint_names) == set(names)


def test_a_table_without_names_may_do_without_the_gripper(tmp_path: Path) -> None:
    urdf = write_urdf(tmp_path, robot(arms=("left",), gripper=True))
    q = swing(("lift", *LEFT), ("lift", *LEFT))
    np.savetxt(tmp_path / "bare.csv", np.column_stack([T, q, 3.0 * q**2 + 1.0]), delimiter=",")
    assert guess_mapping(tmp_path / "bare.csv", urdf).mapping.joints == ("lift", *LEFT)
