"""What a session holds, as columns of numpy arrays."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fri.errors import DataError

__all__ = ["ControllerModelColumns", "Gap", "JointColumns", "Phase", "StatusColumns"]


class Phase(NamedTuple):
    """Beginning of a phase of the experiment: log time [ns] and name."""

    log_time: int
    name: str


class Gap(NamedTuple):
    """Samples missing before the row `row`: how many, and the log times of the rows around [ns]."""

    row: int
    lost: int
    before: int
    after: int


@dataclass(frozen=True)
class JointColumns:
    """One channel of joint states, n samples of J joints, in the order of the file.

    log_time, publish_time : (n,) int64, host time and the source's time [ns]
    sequence : (n,) int64, counter of the source; a gap is a lost sample
    position [rad], velocity [rad/s], effort [Nm] : (n, J) float64, or (n, 0) where the channel has none
    source : file, for messages
    """

    topic: str
    names: tuple[str, ...]
    log_time: NDArray[np.int64]
    publish_time: NDArray[np.int64]
    sequence: NDArray[np.int64]
    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    effort: NDArray[np.float64]
    source: str = ""

    def __len__(self) -> int:
        return len(self.log_time)

    @property
    def numbered(self) -> bool:
        """Whether the source counted its samples; a counter that is always zero is none."""
        return bool(self.sequence.any())

    @property
    def gaps(self) -> tuple[Gap, ...]:
        """Lost samples as the counter tells them; none if the samples are not numbered."""
        if not self.numbered:
            return ()
        steps = np.diff(self.sequence)
        return tuple(
            Gap(int(row) + 1, int(steps[row]) - 1, int(self.log_time[row]), int(self.log_time[row + 1]))
            for row in np.flatnonzero(steps > 1)
        )

    @property
    def lost(self) -> int:
        """Number of lost samples between the first and the last."""
        return sum(gap.lost for gap in self.gaps)

    @property
    def period_s(self) -> float:
        """Median time between samples by the source's clock, or the host's if the source gives none [s]."""
        if len(self) < 2:
            return float("nan")
        times = self.publish_time if np.ptp(self.publish_time) > 0 else self.log_time
        return float(np.median(np.diff(times))) * 1e-9

    def select(self, names: Sequence[str]) -> JointColumns:
        """The same samples with the joints `names` in this order.

        DataError names a joint that is not there.
        """
        wanted = tuple(names)
        if wanted == self.names:
            return self
        for name in wanted:
            if name not in self.names:
                near = difflib.get_close_matches(name, self.names, n=1)
                advice = f"did you mean {near[0]!r}?" if near else f"it has {', '.join(self.names)}"
                raise DataError(
                    f"{self.source}: {self.topic} at {stamp(self.log_time)} has no joint {name!r}; {advice}"
                )
        columns = [self.names.index(name) for name in wanted]

        def pick(values: NDArray[np.float64]) -> NDArray[np.float64]:
            return values[:, columns] if values.shape[1] else values

        return dataclasses.replace(
            self,
            names=wanted,
            position=pick(self.position),
            velocity=pick(self.velocity),
            effort=pick(self.effort),
        )

    def rows(self, start: int, stop: int) -> JointColumns:
        """The samples with `start` <= log time < `stop` [ns]."""
        low, high = np.searchsorted(self.log_time, [start, stop], side="left")
        part = slice(int(low), int(high))
        return dataclasses.replace(
            self,
            log_time=self.log_time[part],
            publish_time=self.publish_time[part],
            sequence=self.sequence[part],
            position=self.position[part],
            velocity=self.velocity[part],
            effort=self.effort[part],
        )


@dataclass(frozen=True)
class StatusColumns:
    """The channel `/fri/status`, n cycles. Names and units are those of `lwr_msgs/msg/FriStatus`."""

    log_time: NDArray[np.int64]
    publish_time: NDArray[np.int64]
    state: NDArray[np.uint16]
    quality: NDArray[np.uint16]
    sequence: NDArray[np.uint32]
    sample_time: NDArray[np.float64]
    answer_rate: NDArray[np.float32]
    latency: NDArray[np.float32]
    jitter: NDArray[np.float32]
    miss_rate: NDArray[np.float32]
    miss_counter: NDArray[np.uint32]
    power: NDArray[np.uint16]
    control: NDArray[np.uint16]
    error: NDArray[np.uint16]
    warning: NDArray[np.uint16]
    temperature: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.log_time)


@dataclass(frozen=True)
class ControllerModelColumns:
    """The channel `/fri/controller_model`, n samples of the controller's own model, float64.

    mass_matrix (n, 7, 7) [kg m2], gravity (n, 7) [Nm], jacobian (n, 6, 7), estimated_external_torque (n, 7)
    [Nm]
    """

    log_time: NDArray[np.int64]
    publish_time: NDArray[np.int64]
    mass_matrix: NDArray[np.float64]
    gravity: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    estimated_external_torque: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.log_time)


def stamp(times: NDArray[np.int64] | int) -> str:
    """A log time for a message, in seconds; of an array the first."""
    if isinstance(times, np.ndarray):
        if not len(times):
            return "(empty)"
        times = int(times[0])
    return f"t = {times // 10**9}.{times % 10**9:09d} s"
