"""The session of an import, read back and compared with what was written."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fri.errors import DataError, LwrError
from lwr_driver.session import read_session

_PLACES = {
    "position": ("joint", "position"),
    "velocity": ("joint", "velocity"),
    "joint_torque": ("joint", "effort"),
    "motor_torque": ("motor", "effort"),
    "motor_position": ("motor", "position"),
    "command": ("command", "position"),
}


def check_written(path: Path, channels: Mapping[str, tuple[NDArray[np.int64], NDArray[np.float64]]]) -> None:
    """Raise DataError unless the session at `path` holds the times (m,) [ns] and values (m, n) of each channel."""
    try:
        session = read_session(path)
    except LwrError as error:
        raise DataError(f"{path}: the session just written cannot be read back: {error}") from error
    for key, (times, values) in channels.items():
        topic, column = _PLACES[key]
        if topic == "motor" and "motor_torque" not in channels:
            continue
        group = getattr(session, topic)
        found = None if group is None else getattr(group, column)
        if found is None or not np.array_equal(found, values) or not np.array_equal(group.log_time, times):
            raise DataError(f"{path}: the {key.replace('_', ' ')} read back differs from the one written")
