"""Means over cycles, for an arm at rest."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fri.remote import RemoteEnd
from lwr_driver.arm import JOINTS


class CycleMeans:
    """Means over some cycles; sums of deviations from the first one, against rounding."""

    def __init__(self, remote: RemoteEnd) -> None:
        msr = remote.msr
        self._values = (
            msr["msr_jnt_pos"],
            msr["msr_jnt_trq"],
            msr["est_ext_jnt_trq"],
            remote.command["jnt_pos"],
        )
        self._count = 0
        self._first = np.zeros((4, JOINTS))
        self._sum, self._squares = np.zeros((4, JOINTS)), np.zeros((4, JOINTS))

    def add(self, *, first: bool) -> int:
        """Include the present cycle, restarting with the `first`; returns the number of cycles."""
        if first:
            self._count = 0
            self._sum[:] = self._squares[:] = 0.0
            for place, value in enumerate(self._values):
                self._first[place] = value
        for place, value in enumerate(self._values):
            deviation = value - self._first[place]
            self._sum[place] += deviation
            self._squares[place] += deviation * deviation
        self._count += 1
        return self._count

    def write(self, measured: NDArray[np.float64]) -> None:
        """Fill (6, 7): mean q, std q, mean tau, std tau, mean external tau, mean command."""
        mean = self._sum / self._count
        std = np.sqrt(np.maximum(self._squares / self._count - mean**2, 0.0))
        mean += self._first
        measured[0], measured[1], measured[2], measured[3] = mean[0], std[0], mean[1], std[1]
        measured[4], measured[5] = mean[2], mean[3]
