"""The surroundings of the arm: ground, boxes, and the shape of the payload; positions in `base_link`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from fri.errors import ConfigurationError
from fri.quantities import Name, Version, check, entries, within
from lwr_driver.configuration import CONFIGS, find, parse, read_mapping

_Place = Annotated[float, within(-20.0, 20.0, "m")]
_Edge = Annotated[float, within(0.001, 20.0, "m")]
_Near = Annotated[float, within(-1.0, 1.0, "m")]
_Size = Annotated[float, within(0.001, 1.0, "m")]
_Angle = Annotated[float, within(-360.0, 360.0, "deg")]
Angles = tuple[_Angle, _Angle, _Angle]


@dataclass(frozen=True)
class Box:
    """A box: full edge lengths [m], centre [m] and roll, pitch, yaw [deg] in `base_link`."""

    name: Name
    size_m: tuple[_Edge, _Edge, _Edge]
    centre_m: tuple[_Place, _Place, _Place]
    rpy_deg: Angles = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class PayloadShape:
    """Outer shape of a payload in the frame of link 7 [m].

    `sphere`: size_m = (radius,); `cylinder`, along z: (radius, length); `box`: (x, y, z) full edge lengths.
    """

    shape: Literal["sphere", "cylinder", "box"]
    size_m: tuple[_Size, ...]
    centre_m: tuple[_Near, _Near, _Near]
    rpy_deg: Angles = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        check(self)
        wanted = {"sphere": 1, "cylinder": 2, "box": 3}[self.shape]
        if len(self.size_m) != wanted:
            raise ConfigurationError(
                f"payload shape {self.shape} needs {wanted} size(s) above zero, found {list(self.size_m)}"
            )


@dataclass(frozen=True)
class Cell:
    """The surroundings for the collision check of every motion.

    ground_z_m : height of the ground [m]; None if it is out of the arm's range
    margin_m : least distance of every motion [m]
    """

    schema_version: Version = 1
    name: Name = "cell"
    ground_z_m: Annotated[float, within(-5.0, 5.0, "m")] | None = 0.0
    margin_m: Annotated[float, within(0.0, 0.5, "m")] = 0.02
    boxes: Annotated[tuple[Box, ...], entries(0, 500)] = ()

    def __post_init__(self) -> None:
        check(self)
        names = [box.name for box in self.boxes]
        if len(set(names)) != len(names):
            raise ConfigurationError(f"box names {names} are not unique")
        for taken in {"ground", "payload"}.intersection(names):
            raise ConfigurationError(
                f"box name {taken!r} means another body in every message; choose another name"
            )

    @classmethod
    def load(cls, name: str | Path = CONFIGS / "cell.yaml", *, beside: Path | None = None) -> Cell:
        """Read a cell file; ConfigurationError names file, key and remedy."""
        path = find(name, beside=beside)
        return parse(cls, read_mapping(path), path)
