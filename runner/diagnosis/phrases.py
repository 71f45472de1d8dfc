"""What a finding says of its cause, in words that need no table of parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ident.effects import EFFECTS
from runner.diagnosis.words import one_joint, quantity_text

__all__ = ["described", "parameter_rows"]

Values = Mapping[str, tuple[float, float, str]]
"""Value, standard deviation and unit by name."""

_LARGE_RATIO = 1.5


def described(cause: str, parameters: Mapping[str, Any], names: Sequence[str]) -> str:
    """The parameters of a finding as a phrase.

    parameters : by name, `Value` or its plain content. names : of the joints.
    """
    values = {name: _triple(value) for name, value in parameters.items()}
    special = _SPECIAL.get(cause)
    if special is not None:
        try:
            return "; ".join(part for part in special(values, names) if part)
        except KeyError:
            # Of another form than the words know: its parameters speak for themselves.
            pass
    shown = {name: v for name, v in values.items() if not (name in _optional(cause) and v[0] == 0.0)}
    return ", ".join(f"{name.replace('_', ' ')} {_quantity(v, name)}" for name, v in shown.items())


def _optional(cause: str) -> tuple[str, ...]:
    return EFFECTS[cause].optional if cause in EFFECTS else ()


def parameter_rows(cause: str, parameters: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Name, value with standard deviation and unit, and meaning of each parameter."""
    meanings = {p.name: p.meaning for p in EFFECTS[cause].parameters} if cause in EFFECTS else {}
    return [
        (name, quantity_text(*_triple(value)), meanings.get(name, "")) for name, value in parameters.items()
    ]


def _triple(value: Any) -> tuple[float, float, str]:
    if isinstance(value, Mapping):
        return (
            float(value.get("value", math.nan)),
            float(value.get("std") or 0.0),
            str(value.get("unit", "1")),
        )
    return float(value.value), float(value.std), str(value.unit)


def _quantity(triple: tuple[float, float, str], name: str = "") -> str:
    """A value as people say it: shares in percent, angles in degrees as well."""
    value, std, unit = triple
    if name in _SHARES:
        return quantity_text(100.0 * value, 100.0 * std, "1") + " %"
    text = quantity_text(value, std, unit)
    return f"{text} ({math.degrees(value):.2g}°)" if unit == "rad" and abs(value) > 1e-3 else text


_SHARES = {"error", "factor", "change", "share"}


def _wave(values: Values) -> str:
    """Cosine and sine as an amplitude [Nm], with the deviation that both give it."""
    (c, c_std, unit), (s, s_std, _) = values["cosine"], values["sine"]
    size = math.hypot(c, s)
    std = math.hypot(c * c_std, s * s_std) / size if size > 0.0 else max(c_std, s_std)
    return quantity_text(size, std, unit)


def _times(cycles: float) -> str:
    words = {1.0: "once", 2.0: "twice", 3.0: "three times", 4.0: "four times"}
    return words.get(cycles, f"{cycles:g} times")


def _cable(values: Values, names: Sequence[str]) -> list[str]:
    kind = values["kind"][0]
    stiffness = values["stiffness"]
    if kind == 1.0:
        return [f"grows with the cube of the angle, {quantity_text(*stiffness[:2], 'Nm/rad³')}"]
    if kind == 3.0:
        bent = ", ".join(
            f"{name} {_quantity(values[name])}" for name in ("quadratic", "cubic") if name in values
        )
        return [f"{_quantity(stiffness)}, hardening: {bent}"]
    if kind == 4.0:
        return [
            f"{_quantity(stiffness)}, with no pull within {_quantity(values['play'])} of {_quantity(values['slack'])}"
        ]
    if abs(kind) == 2.0:
        where = f"taut {'above' if kind > 0 else 'below'} {_quantity(values['slack'])} and slack elsewhere"
        return [f"{_quantity(stiffness)}, {where}"]
    if kind == 3.0:
        return [f"{_quantity(stiffness)} and {_quantity(values['cubic'])}: it hardens with the angle"]
    if kind == 4.0:
        return [
            f"{_quantity(stiffness)} beyond {_quantity(values['play'])} to either side of {_quantity(values['slack'])}"
        ]
    return [_quantity(stiffness)]


def _sensor_ripple(values: Values, names: Sequence[str]) -> list[str]:
    of_motor = values["ratio"][0] > _LARGE_RATIO
    turn = "a turn of the motor" if of_motor else "a turn of the joint"
    return [f"{_wave(values)}, {_times(values['cycles_per_turn'][0])} {turn}"]


def _gear_ripple(values: Values, names: Sequence[str]) -> list[str]:
    return [f"{_wave(values)}, {_times(values['cycles_per_turn'][0])} a turn of the motor"]


def _friction_position(values: Values, names: Sequence[str]) -> list[str]:
    if values["cycles_per_turn"][0] == 0.0:
        spot = f"{_quantity(values['reach'])} to either side of {_quantity(values['centre'])}"
        size, std, unit = values["cosine"]
        more = f"{quantity_text(abs(size), std, unit)} {'more' if size > 0.0 else 'less'}"
        return [f"{more} in the middle of a spot that reaches {spot}"]
    return [f"{_wave(values)}, {_times(values['cycles_per_turn'][0])} a turn of the joint"]


def _drift(values: Values, names: Sequence[str]) -> list[str]:
    name = "change" if "change" in values else "drift"
    size = f"{name} {_quantity(values[name], name)}"
    constant = values["time_constant"]
    if values.get("heat", (0.0,))[0] > 0.5:
        return [f"{size} with the heat of its own friction, with a time constant of {_quantity(constant)}"]
    if constant[0] > 0.0:
        return [f"{size} while a session lasts, with a time constant of {_quantity(constant)}"]
    if constant[0] < 0.0:
        return [f"{size} against the reference"]
    return [f"{size} from the first session to the others"]


def _asymmetry(values: Values, names: Sequence[str]) -> list[str]:
    parts = [f"viscous {_quantity(values['viscous'])}"]
    if values["parts"][0] == 2.0:
        parts.append(f"Coulomb {_quantity(values['coulomb'])}")
    return [", ".join(parts) + " of half difference"]


def _crosstalk(values: Values, names: Sequence[str]) -> list[str]:
    source = one_joint(round(values["source"][0]), names)
    return [f"{_quantity(values['factor'], 'factor')} of the torque of {source}"]


def _encoder(name: str) -> Callable[[Values, Sequence[str]], list[str]]:
    def phrase(values: Values, names: Sequence[str]) -> list[str]:
        parts = [f"{name} {_quantity(values[name])}"]
        if "width" in values:
            parts.append(f"crossed within {_quantity(values['width'])}")
        place = "the motors" if values["encoder"][0] == 1.0 else "the links"
        return [*parts, f"the encoders sit at {place}"]

    return phrase


def _moment(values: Values) -> str:
    axes = ", ".join(quantity_text(*values[f"moment_{axis}"]) for axis in "xyz")
    mass = f"mass {_quantity(values['mass'])}, " if "mass" in values else ""
    return f"{mass}mass times lever (x, y, z) {axes}"


def _payload_change(values: Values, names: Sequence[str]) -> list[str]:
    when = f"at {_quantity(values['time'])} of session {values['session'][0]:.0f}"
    loose = "it slides back and forth" if values.get("loose", (0.0,))[0] > 0.5 else ""
    return [_moment(values), loose, f"{'from ' * bool(loose)}{when}"]


def _contact(values: Values, names: Sequence[str]) -> list[str]:
    force = ", ".join(quantity_text(*values[f"force_{axis}"]) for axis in "xyz")
    when = f"for {_quantity(values['duration'])} about {_quantity(values['time'])}"
    link = f"on link {values['link'][0]:.0f}"
    return [f"force (x, y, z) {force}", f"{link}, {when} of session {values['session'][0]:.0f}"]


def _viscous(values: Values, names: Sequence[str]) -> list[str]:
    (coefficient, std, _), (exponent, spread, _) = values["coefficient"], values["exponent"]
    slower = (coefficient > 0.0) == (exponent < 1.0)
    law = f"the drag grows {'slower' if slower else 'faster'} than the speed"
    power = quantity_text(exponent, spread, "1")
    size = quantity_text(coefficient, std, "Nm")
    return [law, f"beside the linear term {size} at 1 rad/s with the power {power} of the speed"]


def _gain(values: Values, names: Sequence[str]) -> list[str]:
    error, std, _ = values["error"]
    return [
        f"reads {quantity_text(100.0 * abs(error), 100.0 * std, '1')} % too {'much' if error > 0.0 else 'little'}"
    ]


def _saturation(values: Values, names: Sequence[str]) -> list[str]:
    seen = values.get("seen", (0.0,))[0] > 0.5
    return [
        f"reads no more than {_quantity(values['limit'])}",
        "its samples stop there" if seen else "",
    ]


_SPECIAL: dict[str, Callable[[Values, Sequence[str]], list[str]]] = {
    "cable_spring": _cable,
    "viscous_nonlinear": _viscous,
    "sensor_ripple": _sensor_ripple,
    "gear_ripple": _gear_ripple,
    "friction_position": _friction_position,
    "friction_temperature": _drift,
    "sensor_offset_drift": _drift,
    "friction_asymmetry": _asymmetry,
    "sensor_crosstalk": _crosstalk,
    "joint_elasticity": _encoder("compliance"),
    "backlash": _encoder("gap"),
    "sensor_gain": _gain,
    "sensor_saturation": _saturation,
    "motor_torque_gain": _gain,
    "payload_error": lambda values, names: [_moment(values)],
    "payload_change": _payload_change,
    "contact": _contact,
}
