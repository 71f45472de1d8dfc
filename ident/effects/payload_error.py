"""A payload that is not the announced one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ident.effects.body import Body, body_columns
from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.motion import Motion


class PayloadError(Effect):
    """Mass and first moments of the last link differ by a constant.

    The parameters of the last link, or of the identified payload, take all of it up: it shows only as a
    difference from a reference or from the announced mass.
    """

    cause = "payload_error"
    side = "joint"
    physics = "what hangs on the flange is not what was announced"
    source = "Khalil, Gautier and Lemoine, ICRA 2007"
    parameters = (
        Parameter("mass", "kg", "mass above the announced one", low=-50.0, high=50.0),
        Parameter("moment_x", "kg m", "first moment in x of the last link's frame"),
        Parameter("moment_y", "kg m", "first moment in y"),
        Parameter("moment_z", "kg m", "first moment in z"),
    )
    whole_arm = True
    tell_apart = "weigh the payload, and hold static poses with it and without it"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """Linear in everything."""
        return [{}]

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Torque of a unit mass and unit first moments in the last link, in all rows of loaded sessions."""
        share = float(motion.loaded)
        return tuple(
            Column(motor=share * c.motor, joint=share * c.joint)
            for c in body_columns(motion, 4)
            if c.motor is not None and c.joint is not None
        )

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """Gravity of the difference."""
        return Body(np.array([float(parameters.get(p.name, 0.0)) for p in self.parameters]), -1.0)
