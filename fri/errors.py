"""The exceptions of the project, grouped by who must act.

::

    LwrError                 exit code 1
    ├── ConfigurationError   2   whoever wrote the file or the command line
    ├── RefusedError         3   preflight: the motion may not start as asked
    ├── OperatorError        4   the person at the arm aborted or did not confirm
    ├── RobotError           5   the arm or its controller: drives, brakes, state
    ├── NetworkError         6   the cable, the address, the real-time PC
    └── DataError            7   whoever recorded or imported the measurements

A message has subject, value, limit and advice, for example
"A4 velocity 2.31 rad/s at t = 7.412 s exceeds 1.96 rad/s; lower `speed_scale` in the experiment file."
"""

from __future__ import annotations

from typing import Any


class LwrError(Exception):
    """Base of all errors of this project.

    rows : last cycles of the link before the error, None without a link (dtype `lwr_driver.ring.ROW`)
    """

    exit_code = 1
    rows: Any = None


class ConfigurationError(LwrError, ValueError):
    """A file, an option or an argument is wrong; whoever wrote it must act."""

    exit_code = 2


class RefusedError(LwrError):
    """A check before the motion failed, so nothing was commanded."""

    exit_code = 3


class OperatorError(LwrError):
    """The person at the arm aborted, or a confirmation is missing."""

    exit_code = 4


class RobotError(LwrError):
    """The arm or its controller cannot or may not go on."""

    exit_code = 5


class NetworkError(LwrError, ConnectionError):
    """Packets do not arrive, arrive late, or are malformed."""

    exit_code = 6


class DataError(LwrError, ValueError):
    """Recorded or imported measurements cannot be used as they are."""

    exit_code = 7
