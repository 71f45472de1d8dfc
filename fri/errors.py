"""The exceptions of the project, grouped by who must act.

::

    LwrError                 exit code 1
    ├── ConfigurationError   2   whoever wrote the file or the command line
    │   └── FileError            and the operating system refuses a file, folder or port; an OSError
    ├── RefusedError         3   preflight: the motion may not start as asked
    ├── OperatorError        4   the person at the arm aborted or did not confirm
    ├── RobotError           5   the arm or its controller: drives, brakes, state
    ├── NetworkError         6   the cable, the address, the real-time PC
    └── DataError            7   whoever recorded or imported the measurements

A message has subject, value, limit and advice, for example
"A4 velocity 2.31 rad/s at t = 7.412 s exceeds 1.96 rad/s; lower `speed_scale` in the experiment file."
"""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

# Advice by the number of the operating system's error.
_ADVICE = {
    errno.ENOSPC: "make room on that disk, or choose a place on another one",
    errno.EDQUOT: "your quota on that disk is used up; remove files, or choose a place on another one",
    errno.EFBIG: "the limit for the size of a file is reached (`ulimit -f`)",
    errno.EACCES: "its owner or mode forbids it to this user; change them (`ls -ld`), or choose another place",
    errno.EPERM: "its owner or mode forbids it to this user; change them (`ls -ld`), or choose another place",
    errno.EROFS: "that disk is mounted read-only; choose another place",
    errno.ENOENT: "make the folder first, or correct the path",
    errno.ENOTDIR: "a part of the path is a file, not a folder; correct the path",
    errno.EISDIR: "it is a folder; name a file in it",
    errno.EEXIST: "choose another name, or remove it",
    errno.ENOTEMPTY: "choose another folder, or empty it",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.ELOOP: "its links lead in a circle; correct them",
    errno.EMFILE: "too many files are open; end other programs of yours or raise `ulimit -n`",
    errno.ENFILE: "too many files are open on this computer; end other programs",
    errno.ENOMEM: "end other programs to free memory",
    errno.EAGAIN: "too many processes run; end other programs or raise `ulimit -u`",
    errno.EIO: "the disk does not work; choose a place on another one",
    errno.ESTALE: "the network disk is gone; choose a place on a disk of this computer",
    errno.EADDRINUSE: "another program uses this port; end it, or choose another port",
    errno.EADDRNOTAVAIL: "no network card of this computer has this address; see `ip address`",
    errno.ENETUNREACH: "no network card leads there; check cable and addresses, see `ip address`",
}


class LwrError(Exception):
    """Base of all errors of this project.

    rows : last cycles of the link before the error, None without a link (dtype `lwr_driver.ring.ROW`)
    """

    exit_code = 1
    rows: Any = None


class ConfigurationError(LwrError, ValueError):
    """A file, an option or an argument is wrong; whoever wrote it must act."""

    exit_code = 2


class FileError(ConfigurationError, OSError):
    """The operating system refuses a file, a folder, a port or a process; `advice` by the kind of refusal."""

    @classmethod
    def of(cls, error: OSError, subject: str = "", advice: str = "") -> FileError:
        """The error of the operating system as one with a subject, its cause and advice.

        subject : instead of the file named by the error; advice : instead of the usual one
        """
        named = subject or " and ".join(
            str(name) for name in (error.filename, error.filename2) if name is not None
        )
        cause = error.strerror or str(error) or type(error).__name__
        text = f"{named}: {cause}" if named else cause
        remedy = advice or _ADVICE.get(error.errno or 0, "see that the place exists and is yours to use")
        return cls(f"{text}; {remedy}")


@contextmanager
def naming(path: object) -> Iterator[None]:
    """Name `path` in an error of the operating system without a file name, such as a full disk."""
    try:
        yield
    except OSError as error:
        if isinstance(error, LwrError) or error.filename is not None:
            raise
        raise FileError.of(error, str(path)) from error


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
