"""Quantities and joints in words."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence

from ident.dynamics.parameters import printed_unit

Triple = tuple[float, float, str]
Values = Mapping[str, Triple]
"""Value, standard deviation and unit by name."""
MODELS = "the model's"
"""What a value is told against: the base model's own, which is the healthy arm's where there is a reference."""


def quantity_text(value: float, std: float, unit: str) -> str:
    """A value with its standard deviation to two digits, and no more digits of the value."""
    unit = "" if unit == "1" else f" {printed_unit(unit)}"
    if not (std > 0.0 and math.isfinite(std)):
        return f"{value:.4g}{unit}"
    places = max(0, 1 - math.floor(math.log10(std)))
    if places > 4:
        return f"{value:.4g} ± {std:.2g}{unit}"
    shown, spread = f"{value:.{places}f}", f"{std:.{places}f}"
    while "." in shown and shown[-1] == spread[-1] == "0":
        shown, spread = shown[:-1].rstrip("."), spread[:-1].rstrip(".")
    return f"{shown} ± {spread}{unit}"


def quantity(triple: Triple, *, share: bool = False) -> str:
    """A value for reading: a share in percent, an angle in degrees too."""
    value, std, unit = triple
    if share:
        return quantity_text(100.0 * value, 100.0 * std, "1") + " %"
    text = quantity_text(value, std, unit)
    return f"{text} ({math.degrees(value):.2g}°)" if unit == "rad" and abs(value) > 1e-3 else text


def wave(values: Values) -> str:
    """Cosine and sine as an amplitude, with the standard deviation from both."""
    (c, c_std, unit), (s, s_std, _) = values["cosine"], values["sine"]
    size = math.hypot(c, s)
    std = math.hypot(c * c_std, s * s_std) / size if size > 0.0 else max(c_std, s_std)
    return quantity_text(size, std, unit)


def times(cycles: float) -> str:
    """A number of cycles: once, twice."""
    words = {1.0: "once", 2.0: "twice", 3.0: "three times", 4.0: "four times"}
    return words.get(cycles, f"{cycles:g} times")


def spoken(name: str) -> str:
    """A name of a cause or parameter in words."""
    return name.replace("_", " ")


def joints_text(joints: Sequence[int], names: Sequence[str]) -> str:
    """Joints (from 1) as `joint A2` or `joints A2, E1`, `whole arm` for none."""
    if not joints:
        return "whole arm"
    if len(joints) == 1:
        return one_joint(joints[0], names)
    return "joints " + ", ".join(names[j - 1] if 0 < j <= len(names) else str(j) for j in joints)


def one_joint(joint: int, names: Sequence[str]) -> str:
    """A joint (from 1) as `joint A2`; its name alone if it contains "joint" already."""
    name = names[joint - 1] if 0 < joint <= len(names) else str(joint)
    return name if "joint" in name.lower() else f"joint {name}"


def named(text: str, names: Sequence[str]) -> str:
    """A sentence with the names of joints in place of their numbers."""
    return re.sub(r"\bjoint (\d+)\b", lambda match: one_joint(int(match.group(1)), names), text)
