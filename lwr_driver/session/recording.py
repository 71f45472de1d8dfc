"""From rows of the ring to a session log: the messages of a cycle, and their times.

Everything here depends on the rows alone: equal rows give equal files, in any batches.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fri.packets import MSR
from lwr_driver.ring import NO_PHASE
from lwr_driver.session.messages import FRI_STATUS, fixed_layout
from lwr_driver.session.motor_torque import KrlMotorTorque, KrlTorqueDecoder
from lwr_driver.session.writer import ExitStatus, SessionWriter

_STATUS_FIELDS = tuple(name for name in fixed_layout(FRI_STATUS).fields if name in (MSR.names or ()))
NO_PHASE_NAME = "monitor"
"""Phase of cycles without one, after another phase."""


@dataclass(frozen=True)
class SessionRequest:
    """A session to be recorded.

    path : the new file; joint_names : of the arm in kinematic order; metadata : see `session_metadata`
    robot_description : URDF text, also for `/tf`; attachments : file name -> content
    phase_names : names for the numbers in the rows' `phase`
    motor_torque : places of the motor torques in the KRL variables; None records none
    virtual_epoch_ns : in lock step, the log time of packet 0; log times then count packets from there [ns]
    fsync : force each chunk to the disk
    """

    path: Path
    joint_names: tuple[str, ...]
    metadata: Mapping[str, str]
    robot_description: str | None = None
    attachments: Mapping[str, bytes] = field(default_factory=dict)
    phase_names: tuple[str, ...] = ()
    motor_torque: KrlMotorTorque | None = None
    virtual_epoch_ns: int | None = None
    fsync: bool = False


@dataclass(frozen=True)
class Recorded:
    """End of a recording.

    samples : rows in the log; missed : packets of the controller not in it
    overruns : rows dropped by the loop, the ring being full; rejected : rows without a rising packet count
    motor_samples, motor_lost : fresh motor torques in the log, and overwritten ones
    motor_rejected : motor torques left out, not being finite
    error : reason of an incomplete file; empty for a complete one
    """

    path: Path
    exit_status: ExitStatus
    reason: str
    samples: int
    missed: int
    overruns: int = 0
    rejected: int = 0
    motor_samples: int = 0
    motor_lost: int = 0
    motor_rejected: int = 0
    error: str = ""


class Recording:
    """One session being recorded. Errors as `SessionWriter`.

    utc_offset_ns : UTC minus CLOCK_MONOTONIC, measured once, so no clock jump gets into the log
    """

    def __init__(self, request: SessionRequest, utc_offset: int) -> None:
        self.request = request
        self.rejected = 0
        self._utc_offset = utc_offset
        self._sequence: int | None = None
        self._log_time = 0
        self._counted: tuple[int, int] | None = None  # last packet count and its controller time [ns]
        self._phase = NO_PHASE
        self._phase_names = list(request.phase_names)
        self._decoder = None if request.motor_torque is None else KrlTorqueDecoder(request.motor_torque)
        virtual = request.virtual_epoch_ns
        self._writer = SessionWriter(
            request.path,
            request.joint_names,
            request.metadata,
            robot_description=request.robot_description,
            attachments=request.attachments,
            start_ns=time.monotonic_ns() + utc_offset if virtual is None else virtual,
            fsync=request.fsync,
        )

    def add_phases(self, names: tuple[str, ...]) -> int:
        """Add phase names; returns the number of the first."""
        self._phase_names += names
        return len(self._phase_names) - len(names)

    def write(self, rows: NDArray[Any]) -> None:
        """Record rows of dtype `ROW` in the order of their publication."""
        rows = self._rising(rows)
        if not len(rows):
            return
        msr = rows["msr"]
        sequence = np.ascontiguousarray(rows["sequence"])
        # float32 seconds, exact to the microsecond
        sample_time = np.rint(msr["msr_sample_time"].astype(np.float64) * 1e6).astype(np.int64) * 1000
        publish_time = self._controller_times(sequence, sample_time)
        log_time = self._log_times(rows, publish_time)
        writer = self._writer
        position = msr["msr_jnt_pos"]
        writer.write_joint_states(
            log_time, position, msr["msr_jnt_trq"], publish_time=publish_time, sequence=sequence
        )
        sent = rows["answered"] != 0
        writer.write_joint_command(
            log_time[sent],
            rows["cmd"]["jnt_pos"][sent],
            publish_time=publish_time[sent],
            sequence=sequence[sent],
        )
        status = {name: msr[name] for name in _STATUS_FIELDS}
        status["sequence"], status["sample_time"] = sequence, sample_time * 1e-9
        writer.write_status(log_time, status, publish_time=publish_time, sequence=sequence)
        taken = writer.slow("50 Hz", publish_time)
        slow = {"publish_time": publish_time[taken], "sequence": sequence[taken]}
        writer.write_controller_model(
            log_time[taken],
            mass_matrix=msr["mass_matrix"][taken],
            gravity=msr["gravity"][taken],
            jacobian=msr["jacobian"][taken],
            estimated_external_torque=msr["est_ext_jnt_trq"][taken],
            **slow,
        )
        writer.write_link_frames(log_time[taken], position[taken], publish_time=publish_time[taken])
        self._write_phases(rows["phase"], log_time, publish_time)
        if self._decoder is not None:
            fresh = self._decoder.decode(log_time, publish_time, msr["krl_real"], msr["krl_int"])
            writer.write_motor_states(
                fresh.log_time, fresh.effort, publish_time=fresh.publish_time, sequence=fresh.sequence
            )
        writer.advance(int(log_time[-1]))

    def close(
        self, exit_status: ExitStatus, reason: str, overruns: int = 0, restarts: int | None = None
    ) -> Recorded:
        """End the session; `Recorded.error` tells of an incomplete file.

        restarts : of the controller, None if unknown
        """
        decoder, error = self._decoder, ""
        more = {"overruns": str(overruns), "rejected": str(self.rejected)}
        if restarts is not None:
            more["restarts"] = str(restarts)
        if decoder is not None:
            more |= {
                "motor_samples": str(decoder.fresh),
                "motor_lost": str(decoder.lost),
                "motor_restarts": str(decoder.restarts),
                "motor_torn": str(decoder.torn),
                "motor_rejected": str(decoder.rejected),
            }
        try:
            self._writer.close(exit_status, reason, more)
        except (ValueError, OSError) as failure:
            error, exit_status = str(failure), "fail"
        return Recorded(
            path=self.request.path,
            exit_status=exit_status,
            reason=reason,
            samples=self._writer.samples,
            missed=self._writer.missed,
            overruns=overruns,
            rejected=self.rejected,
            motor_samples=decoder.fresh if decoder is not None else 0,
            motor_lost=decoder.lost if decoder is not None else 0,
            motor_rejected=decoder.rejected if decoder is not None else 0,
            error=error,
        )

    def _rising(self, rows: NDArray[Any]) -> NDArray[Any]:
        """The rows with a rising packet count; the others are counted and dropped."""
        if not len(rows):
            return rows
        sequence = rows["sequence"]
        highest = np.maximum.accumulate(sequence)
        before = np.concatenate(
            [[sequence[0] - 1 if self._sequence is None else self._sequence], highest[:-1]]
        )
        if self._sequence is not None:
            before = np.maximum(before, self._sequence)
        good = sequence > before
        self.rejected += int((~good).sum())
        if good.any():
            self._sequence = int(sequence[good][-1])
        return rows if good.all() else rows[good]

    def _controller_times(
        self, sequence: NDArray[np.int64], sample_time: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """The controller's clock: packet count times sample time, continuous across its changes."""
        count, time_ns = self._counted or (int(sequence[0]), int(sequence[0] * sample_time[0]))
        times: NDArray[np.int64] = time_ns + np.cumsum(np.diff(sequence, prepend=count) * sample_time)
        self._counted = int(sequence[-1]), int(times[-1])
        return times

    def _log_times(self, rows: NDArray[Any], publish_time: NDArray[np.int64]) -> NDArray[np.int64]:
        """Strictly increasing log times: packets read in the same nanosecond are put one apart."""
        epoch = self.request.virtual_epoch_ns
        times = rows["t_recv"] + self._utc_offset if epoch is None else publish_time + epoch
        count = np.arange(len(times))
        times = np.maximum(np.maximum.accumulate(times - count), self._log_time + 1) + count
        self._log_time = int(times[-1])
        return np.asarray(times, dtype=np.int64)

    def _write_phases(
        self, phase: NDArray[np.int32], log_time: NDArray[np.int64], publish_time: NDArray[np.int64]
    ) -> None:
        changes = np.flatnonzero(np.diff(phase, prepend=np.int32(self._phase)))
        for row in changes.tolist():
            number = int(phase[row])
            if number == NO_PHASE:
                name = NO_PHASE_NAME
            elif 0 <= number < len(self._phase_names):
                name = self._phase_names[number]
            else:
                name = f"phase {number}"
            self._writer.write_phase(int(log_time[row]), name, publish_time=int(publish_time[row]))
        if len(phase):
            self._phase = int(phase[-1])


def utc_offset_ns() -> int:
    """UTC minus CLOCK_MONOTONIC [ns], from the tightest of several readings."""
    readings = []
    for _ in range(15):
        before = time.monotonic_ns()
        utc = time.time_ns()
        after = time.monotonic_ns()
        readings.append((after - before, utc - (before + after) // 2))
    return min(readings)[1]
