from __future__ import annotations

from pathlib import Path

import pytest

from fri.errors import ConfigurationError
from lwr_driver.arm import Arm
from lwr_driver.configuration import CONFIGS


def written(folder: Path, entry: str) -> Path:
    path = folder / "arm.yaml"
    text = (CONFIGS / "lwr4plus.yaml").read_text()
    path.write_text(text.replace("{name: A2,", f"{{name: A2, {entry},"))
    return path


def test_the_sign_of_a_torque_sensor_is_in_the_arm_file(tmp_path: Path) -> None:
    assert Arm.load().torque_sign.tolist() == [1.0] * 7
    assert Arm.load(written(tmp_path, "torque_sign: -1")).torque_sign.tolist() == [1, -1, 1, 1, 1, 1, 1]
    with pytest.raises(ConfigurationError, match="torque_sign`: 2 is outside -1 to 1"):
        Arm.load(written(tmp_path, "torque_sign: 2"))
