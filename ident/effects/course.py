"""The course of a drift: within each session, at a moment of one, from one session to the next, or since the reference.

Between two sessions a zero moves, or a drive cools down, by an unknown amount. Compared with a reference each session
then has a value of its own: a level of the first ones and a step to the later ones. One number for all of them would
leave the rest to any cause with another mean in each session. Without a reference the base parameters hold the level,
and only the step shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal

import numpy as np

from ident.effects.effect import Effect, Form, FormName, Parameter, Parameters, Setting, Shape
from ident.effects.motion import ArmMotion, Floats, first_order
from ident.effects.words import Values, quantity

TIME_CONSTANT = (
    Parameter("time_constant", "s", "within a session", shape=True, low=0.0),
    Parameter(
        "since",
        "1",
        "number of the first session after a change between the sessions",
        shape=True,
        fixed=True,
    ),
)
MOMENT = (
    Parameter("time", "s", "of a step, from the start of its session", shape=True),
    Parameter("session", "1", "number of the session of the step or drift", shape=True, fixed=True),
)
# Time constants to begin with, over the longest session: from a part of it on, and that of a steady drift.
_SHARES, _STEADY = (0.15, 0.4, 1.0), 5.0
_MINUTE_S = 60.0
# Time constants of a heat that outlasts the pause between sessions [s].
_LASTING_S = (300.0, 1200.0, 5000.0)


class Course(Form):
    """How a value drifts: as 1 - exp(-t / time_constant) in each session; steadily, by so much a minute, in all
    sessions or in one; with the heat of the drive's friction in place of the time; with that heat carried over from
    session to session; from session `since` on, without and with a level of the sessions before it; in all sessions;
    from a moment of a session on, for good and until the end of that session.
    """

    WITHIN = "within a session", "change", "drift", "time_constant"
    STEADY = "steadily within a session", "drift"
    STEADY_IN_ONE = "steadily within one session", "drift", "session"
    HEATED = "heated by friction", "change", "time_constant"
    CARRIED = "heat carried over", "change", "time_constant"
    STEP = "between sessions", "change", "drift", "since"
    LEVEL_AND_STEP = "level, and step between sessions", "change", "level", "drift", "zero", "since"
    SINCE_REFERENCE = "since the reference", "change", "drift"
    STEP_WITHIN = "step within a session", "drift", "time", "session"
    STEP_UNDONE = "step within a session, undone after it", "drift", "time", "session"


class Drifting(Effect):
    """An effect with a course in time; its first parameter is the change, its second one the level of all sessions.

    courses : forms of the drift within each session; singly : those within one of several.
    """

    courses: ClassVar[tuple[Course, ...]]
    singly: ClassVar[tuple[Course, ...]] = ()
    forms = Course
    depends_on = "time"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """From a fifth of the session to a steady drift, and between sessions if there are several."""
        longest = max(setting.durations_s)
        steady = Course.STEADY in self.courses
        times = [share * longest for share in (_SHARES if steady else (*_SHARES, _STEADY))]
        lasting = _LASTING_S if setting.pauses else ()
        step = Course.LEVEL_AND_STEP if setting.compared else Course.STEP
        return [
            *(
                Shape(form, time_constant=time)
                for form in self.courses
                if form is not Course.STEADY
                for time in (lasting if form is Course.CARRIED else times)
            ),
            *([Shape(Course.STEADY)] if steady else []),
            *(
                Shape(form, session=k)
                for form in self.singly
                if setting.sessions > 1
                for k in range(1, setting.sessions + 1)
            ),
            *(Shape(step, since=k) for k in range(2, setting.sessions + 1)),
            Shape(Course.SINCE_REFERENCE),
        ]

    @property
    def known_forms(self) -> tuple[Form, ...]:
        """Those within a session, all between sessions, and those at a moment."""
        return (
            *self.courses,
            *self.singly,
            Course.STEP,
            Course.LEVEL_AND_STEP,
            Course.SINCE_REFERENCE,
            *self.onsets,
        )

    def mode(self, shape: Shape) -> Literal["within", "between"]:
        """Within a session or between sessions."""
        lasting = shape.form in (Course.STEP, Course.LEVEL_AND_STEP, Course.SINCE_REFERENCE)
        return "between" if lasting else "within"

    def passing(self, shape: Shape) -> bool:
        """Between sessions, or in one of them alone."""
        return super().passing(shape) or shape.form in (*self.onsets, *self.singly)

    def lasts(self, form: Form | None, motion: ArmMotion) -> bool:
        """Unless it is undone."""
        return form is not Course.STEP_UNDONE

    def course(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Floats, ...]:
        """Factor (N,) of each coefficient."""
        constant = shape.get("time_constant", 0.0)
        if shape.form is Course.HEATED:
            return (motion.along(lambda m: _warmth(m, joint, constant, 0.0), "heated", joint, constant),)
        if shape.form is Course.CARRIED:
            return (motion.along(lambda m: _carried(m, joint, constant), "carried", joint, constant),)
        if shape.form is Course.WITHIN:
            return (1.0 - np.exp(-motion.time / shape["time_constant"]),)
        if shape.form is Course.STEADY:
            return (motion.time / _MINUTE_S,)
        if shape.form is Course.STEADY_IN_ONE:
            return (float(motion.session + 1 == round(shape["session"])) * motion.time / _MINUTE_S,)
        whole = np.ones(len(motion.time))
        if shape.form is Course.SINCE_REFERENCE:
            return (whole,)
        if shape.form in self.onsets:
            later = motion.session + 1 - round(shape["session"])
            if later == 0:
                return (np.where(motion.time >= shape["time"], 1.0, 0.0),)
            return (float(later > 0 and self.lasts(shape.form, motion)) * whole,)
        step = float(motion.session + 1 >= round(shape.get("since", 2.0))) * whole
        return (step, whole) if shape.form is Course.LEVEL_AND_STEP else (step,)

    def in_session(self, parameters: Parameters, form: FormName, number: int | None) -> Parameters:
        """Without the step in the sessions before it, and from the start in those after it."""
        course, change = self.form_of(form), self.linear[0].name
        if course in self.singly and (number is None or number + 1 != round(parameters["session"])):
            return {**parameters, change: 0.0}
        between = course in (Course.STEP, Course.LEVEL_AND_STEP)
        if between and number is not None and number + 1 < parameters.get("since", 2.0):
            return {**parameters, change: 0.0}
        if course in self.onsets and (number is None or number + 1 != round(parameters["session"])):
            before = number is not None and number + 1 < parameters["session"]
            gone = before or course is Course.STEP_UNDONE
            return {**parameters, "time": 0.0, **({change: 0.0} if gone else {})}
        return parameters

    def drift(self, parameters: Parameters, form: FormName, time_s: float) -> float:
        """Change and level of a simulated arm at a time of the session [s]; without the heat of HEATED form."""
        change, level = self.coefficients_of(parameters)
        if self.form_of(form) is Course.WITHIN:
            change *= 1.0 - np.exp(-time_s / parameters["time_constant"])
        if self.form_of(form) in (Course.STEADY, Course.STEADY_IN_ONE):
            change *= time_s / _MINUTE_S
        if self.form_of(form) in self.onsets:
            change *= float(time_s >= parameters["time"])
        return float(change + level)

    def sentence(self, values: Values, form: Form | None, names: Sequence[str]) -> list[str]:
        """Size and course."""
        first = self.linear[0]
        size = f"{first.name} {quantity(values[first.name], share=first.share)}"
        if form is Course.STEP or form is Course.LEVEL_AND_STEP:
            return [f"{size} from session {values['since'][0]:.0f} on"]
        if form is Course.SINCE_REFERENCE:
            return [f"{size} against the reference"]
        if form is Course.STEADY:
            return [f"{size} a minute"]
        if form is Course.STEADY_IN_ONE:
            return [f"{size} a minute in session {values['session'][0]:.0f} alone"]
        if form in self.onsets:
            step = f"{size} at {quantity(values['time'])} of session {values['session'][0]:.0f}"
            return [step, *(["undone after it"] if form is Course.STEP_UNDONE else [])]
        when = "while a session lasts" if form is Course.WITHIN else "with the heat of its own friction"
        when += ", kept from session to session" if form is Course.CARRIED else ""
        return [f"{size} {when}, with a time constant of {quantity(values['time_constant'])}"]


def _carried(motion: ArmMotion, joint: int, time_constant: float) -> Floats:
    """Warmth (N,) of a drive with the heat left over from the motions before."""
    past: list[ArmMotion] = [motion]
    while past[-1].earlier is not None:
        past.append(past[-1].earlier)
    start, end_s, found = 0.0, past[-1].begun_s, np.zeros(0)
    for one in reversed(past):
        pause = max(0.0, one.begun_s + float(one.time[0]) - end_s)
        start *= float(np.exp(-pause / time_constant))
        found = _warmth(one, joint, time_constant, start)
        start, end_s = float(found[-1]), one.begun_s + float(one.time[-1])
    return found


def _warmth(motion: ArmMotion, joint: int, time_constant: float, start: float) -> Floats:
    """Warmth (N,) of a drive by the power of its friction, over that at 1 rad/s, from `start` on."""
    usual = max(float(motion.friction(np.ones((1, motion.n)))[0, joint]), 1e-9)
    power = motion.friction_power(joint) / usual
    warmth: Floats = first_order(power, np.exp(-motion.dt / time_constant), start)
    return warmth
