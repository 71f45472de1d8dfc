"""The FRI loop in a process of its own: the handle that starts and ends it, and its entry.

The process is a fresh interpreter. It imports numpy, ruckig, pinocchio and `fri` only, and with real-time rights
the compiled `lwr_driver.turnaround`. It inherits the shared memory and a pipe, and writes one line to the pipe:
ready, or the reason why not. It ignores Ctrl-C, and ends when its parent is gone.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from types import FrameType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fri import interpreter
from fri.errors import ConfigurationError, FileError, LwrError, NetworkError
from fri.in_process import Network
from lwr_driver import realtime
from lwr_driver.arm import ArmLimits
from lwr_driver.contact import ContactSettings, ContactWatch, ExpectedArm
from lwr_driver.control import Control, Word
from lwr_driver.loop import Loop, LoopSettings
from lwr_driver.pace import Pace
from lwr_driver.realtime import Rights, Shortage
from lwr_driver.ring import Ring

_BOOT = "import sys; from lwr_driver.loop_process import main; main(sys.argv[1:])"
_START_TIMEOUT_S = 60.0
_END_TIMEOUT_S = 3.0


@dataclass(frozen=True)
class Scheduling:
    """Scheduling of the process.

    apply : ask for real-time rights; required : refuse to start without them
    """

    apply: bool
    required: bool
    priority: int = 80
    cpu: int | None = None


class LoopProcess:
    """Starts the loop and waits until it listens.

    Raises NetworkError if the address cannot be bound or required rights are missing, ConfigurationError if
    the process cannot be started.

    watch : the expected arm, the limits of torque and contact, and the torque limits of the joints (7,) [Nm]
    rights : rights of the process; port : its UDP port; pid : its process id
    """

    def __init__(
        self,
        settings: LoopSettings,
        limits: ArmLimits,
        control: Control,
        ring: Ring,
        scheduling: Scheduling,
        watch: Watch,
    ) -> None:
        self._control = control
        order = {
            **order_of(settings, limits, control, watch),
            "scheduling": asdict(scheduling),
            "control": control.descriptor,
            "ring": ring.inherited,
            "parent": os.getpid(),
        }
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the process
        try:
            self._process = subprocess.Popen(
                interpreter.command("-c", _BOOT, json.dumps(order)),
                pass_fds=(control.descriptor, ring.descriptor),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                env=interpreter.environment(),
                start_new_session=True,
            )
        except OSError as error:
            self._errors.close()
            raise FileError.of(error, "the loop process cannot be started") from error
        try:
            answer = self._ready()
        except BaseException:
            self._process.kill()
            self._process.wait()
            self._errors.close()
            raise
        self.port = int(answer["port"])
        self.rights = Rights(
            tuple(Shortage(**shortage) for shortage in answer["missing"]),
            tuple(Shortage(**shortage) for shortage in answer["advice"]),
            answer["processor"],
        )

    @property
    def pid(self) -> int:
        """Process id of the loop."""
        return self._process.pid

    def check(self) -> None:
        """Raise NetworkError if the process has ended by itself."""
        code = self._process.poll()
        if code is not None:
            raise NetworkError(
                f"the loop process {self.pid} ended with code {code}. {self._complaint()}".strip()
            )

    def stop(self) -> None:
        """Ask the process to stop a motion and end; kill it if it does not."""
        if self._process.poll() is None:
            self._control.words[Word.QUIT] = 1
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_END_TIMEOUT_S)
        if self._process.poll() is None:
            # Its end at real-time priority would stop another driver on its processor.
            with contextlib.suppress(OSError):
                os.sched_setscheduler(self.pid, os.SCHED_OTHER, os.sched_param(0))
            self._process.kill()
            self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()
        self._errors.close()

    def _ready(self) -> dict[str, Any]:
        output = self._process.stdout
        assert output is not None
        deadline = time.monotonic() + _START_TIMEOUT_S
        while (remaining := deadline - time.monotonic()) > 0.0:
            if not select.select([output], [], [], remaining)[0]:
                break
            line = output.readline()
            if not line:
                self._process.wait()
                self.check()
            answer: dict[str, Any] = json.loads(line)
            if "error" in answer:
                kinds = {kind.__name__: kind for kind in (NetworkError, ConfigurationError)}
                raise kinds.get(answer["kind"], LwrError)(answer["error"])
            return answer
        raise NetworkError(f"the loop process did not get ready within {_START_TIMEOUT_S:g} s")

    def _complaint(self) -> str:
        with contextlib.suppress(OSError, ValueError):
            self._errors.seek(0)
            lines = self._errors.read().decode(errors="replace").strip().splitlines()
            return lines[-1] if lines else ""
        return ""


Watch = tuple[ExpectedArm, ContactSettings, NDArray[np.float64]]


def order_of(settings: LoopSettings, limits: ArmLimits, control: Control, watch: Watch) -> dict[str, Any]:
    """Everything a `Loop` is made of, as plain data, except for the shared memory itself."""
    return {
        "settings": asdict(settings),
        "limits": {name: np.asarray(value).tolist() for name, value in asdict(limits).items()},
        "watch": [asdict(watch[0]), asdict(watch[1]), watch[2].tolist()],
        "plan_rows": control.plan_rows,
    }


def loop_of(order: dict[str, Any], control: Control, ring: Ring, network: Network | None = None) -> Loop:
    """The loop of an order."""
    settings = dict(order["settings"])
    settings["joint_names"] = tuple(settings["joint_names"])
    limits = ArmLimits(**{name: np.array(value) for name, value in order["limits"].items()})
    expected, contact, tau_max = order["watch"]
    watch = ContactWatch(ExpectedArm(**expected), ContactSettings(**contact), np.array(tau_max))
    return Loop(LoopSettings(**settings), limits, control, ring, watch, network)


def main(arguments: Sequence[str]) -> None:
    """Entry of the loop process: one argument, the order as JSON."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    order = json.loads(arguments[0])
    try:
        scheduling = Scheduling(**order["scheduling"])
        control = Control(order["control"], order["plan_rows"])
        loop = loop_of(order, control, Ring.attach(order["ring"]))
        if not order["settings"]["lock_step"]:
            loop.pace = Pace()
        rights = _become_real_time(loop, control, scheduling) if scheduling.apply else Rights()
        if scheduling.required:
            rights.enforce()
    except LwrError as error:
        realtime.give_back()
        _say({"error": str(error), "kind": type(error).__name__})
        return

    def end(number: int, frame: FrameType | None) -> None:
        control.words[Word.QUIT] = 1

    signal.signal(signal.SIGTERM, end)
    _say({"port": loop.remote.address[1], **asdict(rights)})
    try:
        loop.run(order["parent"])
    finally:
        realtime.give_back()


def _become_real_time(loop: Loop, control: Control, scheduling: Scheduling) -> Rights:
    """Take the granted rights; with all of them and a processor of its own, the loop waits actively."""
    processor, shared = realtime.reserve(scheduling.cpu)
    turnaround, advice = None, [] if shared is None else [shared]
    if processor is not None and realtime.assess(scheduling.priority).ok:
        # Before the rights: the compiler needs much time, and all its memory would be locked. It takes some
        # 500 MB, freed by the kernel at the priority of the process if that is killed.
        try:
            from lwr_driver.turnaround import Turnaround

            turnaround = Turnaround(loop.remote.descriptor, loop.remote.buffer, control.words)
        except Exception as error:  # the loop works without a compiler
            remedy = f"answers take longer; see that numba works and may write its cache ({error})"
            advice.append(Shortage("the code that answers at once cannot be compiled", remedy))
    rights = realtime.set_up(scheduling.priority, processor)
    if rights.ok and rights.processor is not None:
        loop.turnaround = turnaround
    return replace(rights, advice=(*rights.advice, *advice))


def _say(answer: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(answer) + "\n")
    sys.stdout.flush()
