"""What is another in each session: a level of the first ones and a step to the later ones.

Between two sessions a zero moves, or a drive cools down, by whatever it likes. Held against a reference each
session then has a value of its own, and one number for all of them leaves the rest to whatever has another mean
in each session. Without a reference the base parameters hold the level, and only the step shows.
"""

from __future__ import annotations

from ident.effects.effect import Setting, Shape

__all__ = ["shares_of_session", "steps_between"]


def steps_between(setting: Setting) -> list[dict[str, float]]:
    """Shapes of a change between the sessions: a step to each session after the first, with a level before it
    where there is a reference.
    """
    own = {"own": 1.0} if setting.compared else {}
    return [{"time_constant": 0.0, "since": float(k), **own} for k in range(2, setting.sessions + 1)]


def shares_of_session(session: int, shape: Shape) -> tuple[float, ...]:
    """Factors of the columns in a session (from 0): of the step, and of the level where it has its own."""
    if shape["time_constant"] < 0.0:
        return (1.0,)
    step = float(session + 1 >= round(shape.get("since", 2.0)))
    return (step, 1.0) if shape.get("own", 0.0) > 0.5 else (step,)
