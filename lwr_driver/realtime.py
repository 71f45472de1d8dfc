"""Real-time set-up of a process on Linux, with the remedy for each missing right; work without Ctrl-C.

Measured on a busy computer, the scheduler and not the language decides whether an answer leaves within a
millisecond: SCHED_FIFO, a processor of its own and locked memory.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import gc
import os
import platform
import resource
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from fri.errors import NetworkError

_CAP_IPC_LOCK, _CAP_SYS_NICE = 14, 23
_MCL_CURRENT, _MCL_FUTURE = 1, 2
_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4
_PREFAULT_BYTES = 16 * 2**20
_LIMITS_FILE = "/etc/security/limits.d/realtime.conf"
_LOCK_BYTES = 768 * 2**20  # a loop with the compiler loaded takes some 500 MiB

# Held open until `give_back`: closing it lets the processor sleep deeply again.
_awake: list[int] = []
# A bound name of a socket marks a processor as taken; the kernel forgets it with its process, however that ends.
_claims: list[socket.socket] = []
_CLAIM = "\0lwr_driver.processor.{}"


@dataclass(frozen=True)
class Shortage:
    """A missing right and its remedy."""

    what: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.what}: {self.remedy}"


@dataclass(frozen=True)
class Rights:
    """Rights of a process.

    missing : without these no cycle is safe; advice : improvements of the timing
    processor : of the loop, None for any
    """

    missing: tuple[Shortage, ...] = ()
    advice: tuple[Shortage, ...] = ()
    processor: int | None = None

    @property
    def ok(self) -> bool:
        """Whether nothing is missing."""
        return not self.missing

    def enforce(self) -> None:
        """Raise NetworkError, with every remedy, if something is missing."""
        if self.missing:
            lines = "; ".join(str(shortage) for shortage in self.missing)
            raise NetworkError(
                f"this computer grants no real-time operation. {lines}. Then log in again, or allow "
                "operation without real time where a missed answer does no harm (the emulator)"
            )


def assess(priority: int = 80) -> Rights:
    """Rights of a real-time process started by this user; changes nothing."""
    missing, advice = [], _kernel_advice()
    capabilities = _capabilities()
    ceiling = resource.getrlimit(resource.RLIMIT_RTPRIO)[1]
    if not capabilities >> _CAP_SYS_NICE & 1 and 0 <= ceiling < priority:
        missing.append(_no_priority(priority, ceiling))
    lockable = resource.getrlimit(resource.RLIMIT_MEMLOCK)[1]
    if not capabilities >> _CAP_IPC_LOCK & 1 and 0 <= lockable < _LOCK_BYTES:
        missing.append(_no_memory(lockable))
    if _processors() < 2:
        advice.append(
            Shortage("a single processor", "the loop shares it with everything else; use two or more")
        )
    return Rights(tuple(missing), tuple(advice))


def reserve(processor: int | None = None) -> tuple[int | None, Shortage | None]:
    """Take a processor until `give_back`: as asked, else one without a driver. And advice if there is none.

    Isolated ones come first, then the last one down to the second: interrupts prefer the first, and the recorder and
    everything else need one. None if all are taken. The kernel forgets a reservation with its process.
    """
    if processor is not None:
        if _claim(processor):
            return processor, None
        remedy = "name another one in `cpu`, or None to have a free one found"
        return processor, Shortage(f"processor {processor} has a driver already", remedy)
    allowed = sorted(os.sched_getaffinity(0), reverse=True)
    if len(allowed) < 2:
        return None, None
    for candidate in (*_isolated(), *allowed[:-1]):
        if _claim(candidate):
            return candidate, None
    remedy = "answers take longer; use a computer with more processors than drivers"
    return None, Shortage(f"of {len(allowed)} processors each has a driver but the first", remedy)


def set_up(priority: int = 80, processor: int | None = None) -> Rights:
    """Make this process a real-time one as far as allowed; returns its rights.

    priority : of SCHED_FIFO, 1 to 99; processor : to bind to, of `reserve`; None for the first, which no driver has

    Everything that takes long comes before SCHED_FIFO: a collection of garbage at this priority would stop other
    drivers on the same processor for some 50 ms.
    """
    missing, advice = [], _kernel_advice()
    gc.collect()
    gc.freeze()
    gc.disable()
    _prefault()
    library = ctypes.CDLL(None, use_errno=True)
    if library.mlockall(_MCL_CURRENT | _MCL_FUTURE) != 0:
        missing.append(_no_memory(resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]))
    with contextlib.suppress(OSError):
        descriptor = os.open("/dev/cpu_dma_latency", os.O_WRONLY)
        os.write(descriptor, b"\0\0\0\0")
        _awake.append(descriptor)
    if processor is not None:
        try:
            os.sched_setaffinity(0, {processor})
        except OSError as error:
            remedy = f"choose one of {sorted(os.sched_getaffinity(0))} ({error.strerror})"
            missing.append(Shortage(f"no operation on processor {processor}", remedy))
            processor = None
    else:
        # Away from the other drivers; even the end of a killed process takes some 10 ms at its priority.
        with contextlib.suppress(OSError):
            os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError:
        missing.append(_no_priority(priority, resource.getrlimit(resource.RLIMIT_RTPRIO)[0]))
    return Rights(tuple(missing), tuple(advice), processor)


def give_back() -> None:
    """End real-time operation: ordinary scheduling, memory unlocked, processor free for another driver.

    Before the end of the process, for the kernel frees its memory at its priority.
    """
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    ctypes.CDLL(None).munlockall()
    while _awake:
        os.close(_awake.pop())
    while _claims:
        _claims.pop().close()


def _no_priority(priority: int, ceiling: int) -> Shortage:
    interpreter = os.path.realpath(sys.executable)
    return Shortage(
        f"SCHED_FIFO priority {priority} is not granted (limit {max(ceiling, 0)})",
        f"put `@realtime - rtprio {max(priority, 95)}` into {_LIMITS_FILE} and add the user with "
        "`sudo groupadd -f realtime && sudo usermod -aG realtime $USER`, or run "
        f"`sudo setcap cap_sys_nice,cap_ipc_lock+ep {interpreter}`",
    )


def _no_memory(limit: int) -> Shortage:
    return Shortage(
        f"memory cannot be locked (limit {limit // 1024} KiB)",
        f"put `@realtime - memlock unlimited` into {_LIMITS_FILE}",
    )


def _kernel_advice() -> list[Shortage]:
    with contextlib.suppress(OSError):
        if Path("/sys/kernel/realtime").read_text().strip() == "1":
            return []
    if "PREEMPT_RT" in platform.version():
        return []
    remedy = (
        "stalls of some ms are possible at 1 kHz; install the distribution's real-time kernel "
        "(Debian: linux-image-rt-amd64, Ubuntu: `sudo pro enable realtime-kernel`) or use a cycle of 5 ms "
        "or more"
    )
    return [Shortage(f"kernel {platform.release()} is not PREEMPT_RT", remedy)]


def _capabilities() -> int:
    """Effective capabilities as a bit mask."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("CapEff:"):
                return int(line.split()[1], 16)
    return 0


def _processors() -> int:
    return len(os.sched_getaffinity(0))


def _isolated() -> list[int]:
    """Processors kept free of other programs by the kernel's `isolcpus`."""
    found: list[int] = []
    with contextlib.suppress(OSError, ValueError):
        for part in Path("/sys/devices/system/cpu/isolated").read_text().strip().split(","):
            first, _, last = part.partition("-")
            found += range(int(first), int(last or first) + 1)
    return found


def _claim(processor: int) -> bool:
    """Take a processor for this process; False if another driver has it."""
    mark = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        mark.bind(_CLAIM.format(processor))
    except OSError as error:
        mark.close()
        # Without names of this kind nothing can be shared out.
        return error.errno != errno.EADDRINUSE
    _claims.append(mark)
    return True


def _prefault() -> None:
    """Grow the heap, touch its pages and keep them: no page faults later."""
    library = ctypes.CDLL(None, use_errno=True)
    with contextlib.suppress(AttributeError):
        library.mallopt(_M_TRIM_THRESHOLD, -1)
        library.mallopt(_M_MMAP_MAX, 0)
    block = bytearray(_PREFAULT_BYTES)
    block[:: resource.getpagesize()] = b"\1" * len(block[:: resource.getpagesize()])
    del block


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Hold back a KeyboardInterrupt until the block is left: acquiring or giving back is not interrupted.

    Only in the main thread with Python's own handler; elsewhere Ctrl-C raises none.
    """
    main = threading.current_thread() is threading.main_thread()
    if not main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    interrupted = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal interrupted
        interrupted = True

    signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if interrupted:
        raise KeyboardInterrupt
