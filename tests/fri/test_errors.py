from __future__ import annotations

import pytest

from fri.errors import (
    ConfigurationError,
    DataError,
    LwrError,
    NetworkError,
    OperatorError,
    RefusedError,
    RobotError,
)


@pytest.mark.parametrize(
    ("kind", "code"),
    [
        (LwrError, 1),
        (ConfigurationError, 2),
        (RefusedError, 3),
        (OperatorError, 4),
        (RobotError, 5),
        (NetworkError, 6),
        (DataError, 7),
    ],
)
def test_the_exit_code_says_who_must_act(kind, code):
    assert issubclass(kind, LwrError)
    assert kind.exit_code == code
    assert kind("text").rows is None


def test_errors_are_those_of_python_too():
    assert issubclass(ConfigurationError, ValueError)
    assert issubclass(DataError, ValueError)
    assert issubclass(NetworkError, ConnectionError)
