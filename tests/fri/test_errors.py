from __future__ import annotations

import errno
import os

import pytest

from fri.errors import (
    ConfigurationError,
    DataError,
    FileError,
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


@pytest.mark.parametrize(
    ("number", "advice"),
    [
        (errno.ENOSPC, "make room on that disk"),
        (errno.EACCES, "its owner or mode forbids it"),
        (errno.EROFS, "mounted read-only"),
        (errno.ENOENT, "make the folder first"),
        (errno.EADDRINUSE, "choose another port"),
        (errno.EMFILE, "ulimit -n"),
        (errno.ENOTTY, "see that the place exists"),
    ],
)
def test_what_the_operating_system_refuses_has_subject_cause_and_advice(number, advice):
    error = FileError.of(OSError(number, os.strerror(number), "/disk/run.mcap"))
    assert isinstance(error, OSError)
    assert error.exit_code == 2
    assert str(error).startswith(f"/disk/run.mcap: {os.strerror(number)}; ")
    assert advice in str(error)


def test_a_refusal_without_a_number_or_name_has_a_message_too():
    assert str(FileError.of(OSError("broken"), "the trace")) == (
        "the trace: broken; see that the place exists and is yours to use"
    )
    assert str(FileError.of(OSError())).startswith("OSError; ")
