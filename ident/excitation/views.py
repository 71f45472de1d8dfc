"""Any motion, planned or measured, as the criteria see it."""

from __future__ import annotations

import numpy as np

from fri.errors import ConfigurationError
from ident.excitation.estimate import ArmEstimate
from ident.excitation.evaluation import Evaluator
from ident.excitation.information import Columns
from ident.excitation.mechanism import Mechanism
from ident.excitation.motion import Array, ParametricMotion, Samples
from ident.excitation.objectives import View

__all__ = ["motion_view", "samples_view"]


def motion_view(
    motion: ParametricMotion,
    mechanism: Mechanism,
    estimate: ArmEstimate,
    columns: Columns,
    step_s: float = 0.01,
) -> View:
    """A parametric motion sampled every `step_s`, with the true sign of the velocities."""
    count = max(200, round(motion.duration / step_s))
    times = np.arange(count) * (motion.duration / count)
    return samples_view(motion.sample(times), mechanism, estimate, columns)


def samples_view(samples: Samples, mechanism: Mechanism, estimate: ArmEstimate, columns: Columns) -> View:
    """Samples of any motion, measured ones included; jerks are not used."""
    evaluator = Evaluator(mechanism, _NoBasis(), estimate, columns, samples=len(samples.q), refine=1)
    return evaluator.view(list(samples[:3]), exact_sign=True)


class _NoBasis:
    """A basis without functions, for evaluating samples that are given."""

    duration, free = 1.0, 0

    def matrix(self, t: np.typing.ArrayLike, derivative: int = 0) -> Array:
        """No functions."""
        return np.zeros((np.size(t), 0))

    def motion(self, x: Array) -> ParametricMotion:
        """There is none."""
        raise ConfigurationError("samples are no parametric motion")

    def coefficients(self, motion: ParametricMotion) -> Array:
        """None."""
        return np.zeros((motion.joints, 0))

    def grid_factor(self, n: int, derivative: int) -> float:
        """Nothing is known between the samples."""
        return np.inf
