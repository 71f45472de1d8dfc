"""The surroundings of the arm: ground, boxes, and the shape of the payload; positions in `base_link`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from fri.errors import ConfigurationError
from lwr_driver.configuration import find, parse, read_mapping

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Box:
    """A box: full edge lengths [m], centre [m] and roll, pitch, yaw [deg] in `base_link`."""

    name: str
    size_m: Triple
    centre_m: Triple
    rpy_deg: Triple = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if min(self.size_m) <= 0.0:
            raise ConfigurationError(
                f"box {self.name}: size_m {self.size_m} must be above zero in each direction"
            )


@dataclass(frozen=True)
class PayloadShape:
    """Outer shape of a payload in the frame of link 7 [m].

    `sphere`: size_m = (radius,); `cylinder`, along z: (radius, length); `box`: (x, y, z) full edge lengths.
    """

    shape: Literal["sphere", "cylinder", "box"]
    size_m: tuple[float, ...]
    centre_m: Triple
    rpy_deg: Triple = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        wanted = {"sphere": 1, "cylinder": 2, "box": 3}[self.shape]
        if len(self.size_m) != wanted or min(self.size_m) <= 0.0:
            raise ConfigurationError(
                f"payload shape {self.shape} needs {wanted} size(s) above zero, found {list(self.size_m)}"
            )


@dataclass(frozen=True)
class Cell:
    """The surroundings for the collision check of every motion.

    ground_z_m : height of the ground [m]; None if it is out of the arm's range
    margin_m : least distance of every motion [m]
    """

    schema_version: int = 1
    name: str = "cell"
    ground_z_m: float | None = 0.0
    margin_m: float = 0.02
    boxes: tuple[Box, ...] = ()

    def __post_init__(self) -> None:
        if self.schema_version != 1:
            raise ConfigurationError(
                f"schema_version {self.schema_version} is unknown; this software reads 1"
            )
        if not 0.0 <= self.margin_m <= 0.5:
            raise ConfigurationError(f"margin_m {self.margin_m} is not within 0 to 0.5")
        names = [box.name for box in self.boxes]
        if len(set(names)) != len(names):
            raise ConfigurationError(f"box names {names} are not unique")

    @classmethod
    def load(cls, name: str | Path = "cell.yaml", *, beside: Path | None = None) -> Cell:
        """Read a cell file; ConfigurationError names file, key and remedy."""
        path = find(name, beside=beside)
        return parse(cls, read_mapping(path), str(path))
