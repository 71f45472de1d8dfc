"""This computer: address, port, real-time rights, kernel, clock, disk, versions."""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import functools
import os
import platform
import shutil
import socket
import struct
import subprocess
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

from fri.errors import LwrError, NetworkError, RefusedError
from lwr_driver.realtime import assess

_PACKAGES = ("numpy", "scipy", "pin", "ruckig", "numba", "mcap")
_DISTRIBUTION = "lwr-identification"


def software() -> str:
    """Name and version of this software."""
    return f"{_DISTRIBUTION} {metadata.version(_DISTRIBUTION)}"


@functools.cache
def git_commit() -> str:
    """Commit of this software, with `+` after local changes: baked into a wheel, else asked of the checkout.

    Empty if neither is there; a checkout around the installation is of something else and not asked.
    """
    root = Path(__file__).resolve().parents[1]
    baked = Path(__file__).with_name("commit.txt")
    if not (root / ".git").exists():
        return baked.read_text(encoding="utf-8").strip() if baked.is_file() else ""
    ask = functools.partial(
        subprocess.check_output, cwd=root, text=True, timeout=10, stderr=subprocess.DEVNULL
    )
    try:
        commit = ask(["git", "rev-parse", "HEAD"]).strip()
        return commit + ("+" if ask(["git", "status", "--porcelain", "--untracked-files=no"]).strip() else "")
    except (OSError, subprocess.SubprocessError):
        return ""


def versions() -> dict[str, str]:
    """Versions by package, with Python, the platform and the commit of this software."""
    return {
        "software": software(),
        "git_commit": git_commit(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        **{name: metadata.version(name) for name in _PACKAGES},
    }


Verdict = Literal["ok", "advice", "fail"]

LEAST_DISK_MB = 2000.0
_SIOCGIFADDR = 0x8915
_NET = Path("/sys/class/net")
_GOOD_CLOCKS = ("tsc", "kvm-clock", "hyperv_clocksource_tsc_page", "arch_sys_counter")
_CLOCK_UNSYNCHRONISED = 5
_TIMEX_BYTES = 256
_MARKS = {"ok": "ok", "advice": "note", "fail": "FAIL"}


@dataclass(frozen=True)
class ComputerFinding:
    """One item: value, limit, verdict and advice.

    who : error class of a failure, by the person who must act; it gives the exit code.
    """

    subject: str
    value: str
    limit: str
    verdict: Verdict
    advice: str = ""
    who: type[LwrError] = RefusedError

    @property
    def mark(self) -> str:
        """The verdict in a table."""
        return _MARKS[self.verdict]

    def to_dict(self) -> dict[str, Any]:
        """Plain content for JSON."""
        content = asdict(self)
        content.pop("who")
        return content | {"exit_code": self.who.exit_code if self.verdict == "fail" else 0}


def graded(
    subject: str,
    value: str,
    limit: str,
    failure: tuple[bool, str] = (False, ""),
    shortcoming: tuple[bool, str] = (False, ""),
    who: type[LwrError] = NetworkError,
) -> ComputerFinding:
    """A finding from its conditions, each with its advice: of a failure, and of a mere shortcoming."""
    if failure[0]:
        return ComputerFinding(subject, value, limit, "fail", failure[1], who)
    if shortcoming[0]:
        return ComputerFinding(subject, value, limit, "advice", shortcoming[1])
    return ComputerFinding(subject, value, limit, "ok")


@dataclass(frozen=True)
class Interface:
    """A network interface by name, with the kernel's counters."""

    name: str

    def read(self, what: str) -> str:
        """Content of a file of the interface (`operstate`, `statistics/rx_packets`), empty if unreadable."""
        with contextlib.suppress(OSError):
            return (_NET / self.name / what).read_text().strip()
        return ""

    @property
    def received(self) -> int:
        """Packets received since the start of the computer."""
        return int(self.read("statistics/rx_packets") or 0)


def find_interface(address: str) -> Interface | None:
    """The interface with this IPv4 address, or None."""
    wanted = socket.inet_aton(address)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        for _, name in socket.if_nameindex():
            with contextlib.suppress(OSError):
                request = struct.pack("256s", name.encode()[:15])
                if fcntl.ioctl(probe.fileno(), _SIOCGIFADDR, request)[20:24] == wanted:
                    return Interface(name)
    return None


def examine_computer(address: str, port: int, folder: Path, *, realtime: bool) -> list[ComputerFinding]:
    """Every finding without a controller.

    address, port : of the PC's end. folder : of the logs. realtime : real-time rights are needed (a real arm).
    """
    return [
        _interface(address),
        _port(address, port),
        *_rights(needed=realtime),
        _processors(),
        _clock_source(),
        _clock_time(),
        _disk(folder),
        _versions(),
    ]


def _interface(address: str) -> ComputerFinding:
    found = find_interface(address)
    if found is None:
        known = ", ".join(name for _, name in socket.if_nameindex())
        advice = (
            f"set `link.address` to an address of this computer, or give the network card this one: "
            f"sudo ip address add {address}/24 dev CARD (CARD of {known})"
        )
        return ComputerFinding("interface", f"none has {address}", "one", "fail", advice, NetworkError)
    state, errors = found.read("operstate"), int(found.read("statistics/rx_errors") or 0)
    speed = found.read("speed")
    shown = f"{address} on {found.name}, {state}" + (f", {speed} Mbit/s" if speed.isdigit() else "")
    if state not in ("up", "unknown"):
        advice = "plug the cable in; the controller must be switched on"
        return ComputerFinding("interface", shown, "up", "fail", advice, NetworkError)
    if errors:
        advice = "change the cable or the card if the number rises"
        return ComputerFinding(
            "interface", f"{shown}, {errors} receive errors", "up, 0 errors", "advice", advice
        )
    return ComputerFinding("interface", shown, "up", "ok")


def _port(address: str, port: int) -> ComputerFinding:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((address, port))
        except OSError as error:
            advice = (
                f"end the other FRI client (`sudo ss -lunp | grep {port}` names it), or choose another port"
            )
            value = f"UDP {address}:{port}: {error.strerror}"
            return ComputerFinding("port", value, "free", "fail", advice, NetworkError)
    return ComputerFinding("port", f"UDP {address}:{port}", "free", "ok")


def _rights(*, needed: bool) -> list[ComputerFinding]:
    rights = assess()
    found = [
        ComputerFinding("real-time rights", lack.what, "granted", "fail", lack.remedy, NetworkError)
        if needed
        else ComputerFinding("real-time rights", lack.what, "for a real arm", "advice", lack.remedy)
        for lack in rights.missing
    ]
    if rights.ok:
        found.append(
            ComputerFinding("real-time rights", "SCHED_FIFO and locked memory granted", "granted", "ok")
        )
    kernel = next((advice for advice in rights.advice if advice.what.startswith("kernel")), None)
    value = kernel.what if kernel else f"{platform.release()}, PREEMPT_RT"
    lacking = (kernel is not None, kernel.remedy if kernel else "")
    return [*found, graded("kernel", value, "PREEMPT_RT for 1 ms", shortcoming=lacking)]


def _processors() -> ComputerFinding:
    count = len(os.sched_getaffinity(0))
    governors = set()
    for path in Path("/sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor"):
        with contextlib.suppress(OSError):
            governors.add(path.read_text().strip())
    value = f"{count}" + (f", governor {'/'.join(sorted(governors))}" if governors else "")
    if count >= 2 and governors - {"performance"}:
        advice = "sudo cpupower frequency-set -g performance"
        return ComputerFinding("processors", value, "performance", "advice", advice)
    alone = (count < 2, "the loop shares it with all other processes")
    return graded("processors", value, "2", shortcoming=alone)


def _clock_source() -> ComputerFinding:
    path = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
    try:
        source = path.read_text().strip()
    except OSError:
        return ComputerFinding("clock source", "unknown", "a fast one", "advice", f"{path} cannot be read")
    if source not in _GOOD_CLOCKS:
        advice = "reading it takes microseconds; the kernel's messages explain why tsc was given up"
        return ComputerFinding("clock source", source, "tsc", "advice", advice)
    return ComputerFinding("clock source", source, "tsc or as good", "ok")


def _clock_time() -> ComputerFinding:
    # Only the dates in the logs depend on it.
    status = -1
    with contextlib.suppress(OSError, AttributeError):
        status = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES))
    wrong = status < 0 or status == _CLOCK_UNSYNCHRONISED
    advice = "the dates in the logs may be wrong; sudo timedatectl set-ntp true"
    return graded("clock", "not " * wrong + "synchronised", "synchronised", shortcoming=(wrong, advice))


def _disk(folder: Path) -> ComputerFinding:
    place, free = free_disk(folder.resolve())
    if free < 1e6 * LEAST_DISK_MB:
        return ComputerFinding(
            "disk", f"{free / 1e6:.0f} MB free at {place}", f"{LEAST_DISK_MB:.0f} MB", "fail", "make room"
        )
    return ComputerFinding(
        "disk", f"{free / 1e9:.0f} GB free at {place}", f"{LEAST_DISK_MB / 1000:.0f} GB", "ok"
    )


def free_disk(folder: Path) -> tuple[Path, float]:
    """The existing folder nearest above `folder`, and the free space of its disk [bytes]."""
    place = next(place for place in (folder, *folder.parents) if place.exists())
    return place, float(shutil.disk_usage(place).free)


def _versions() -> ComputerFinding:
    found = versions()
    text = ", ".join([found["software"], *(f"{name} {found[name]}" for name in ("python", "numpy", "pin"))])
    return ComputerFinding("versions", text, "", "ok")
