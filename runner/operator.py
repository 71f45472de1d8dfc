"""The person at the arm: mounts payloads, enters load data, confirms. Emulated where the arm is."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import click

from fri.errors import OperatorError
from runner.experiment_file import Payload
from sim_backend.pendant import Pendant

__all__ = ["EmulatedOperator", "Operator", "Person"]


class Operator(Protocol):
    """What the experiment asks of whoever stands at the arm."""

    def swap(self, mounted: Payload | None, wanted: Payload | None) -> None:
        """Have `wanted` on the flange instead of `mounted`, and its load data in the controller."""

    def start_trace(self) -> None:
        """Have the controller's own recording started."""

    def save_trace(self, path: Path) -> bool:
        """Have the controller's recording at `path`; False where it will come later, or never."""


class Person:
    """A person at a terminal.

    assume_yes : confirm by itself, for automation around a real arm
    enters_load : whether load data are entered at the pendant; otherwise they go over the link
    """

    def __init__(self, assume_yes: bool, *, enters_load: bool = True) -> None:
        self._assume_yes = assume_yes
        self._enters_load = enters_load

    def swap(self, mounted: Payload | None, wanted: Payload | None) -> None:
        """Ask for the swap and wait for the confirmation."""
        if wanted is None:
            work = f"Take the payload {mounted.name!r} off" if mounted else "Leave the flange empty"
            load = "set the load data on the controller to the empty flange"
        else:
            work = f"Mount the payload {wanted.name!r}, {wanted.mass:g} kg"
            x, y, z = (1000 * value for value in wanted.com)
            load = (
                f"enter its load data on the controller: {wanted.mass:g} kg, centre of mass "
                f"({x:.0f}, {y:.0f}, {z:.0f}) mm in the frame of link 7"
            )
        if self._enters_load:
            work = f"{work}, then {load}"
        self._confirm(f"{work}. Stay clear of the arm. Ready?")

    def start_trace(self) -> None:
        """Ask for the controller's recording to be started."""
        self._confirm("Start the controller's trace (motor torques and axis positions). Running?")

    def save_trace(self, path: Path) -> bool:
        """Ask for the trace file."""
        if self._assume_yes:
            return path.exists()
        self._confirm(f"Stop the trace and copy its file to {path}. Done?")
        return path.exists()

    def _confirm(self, question: str) -> None:
        if self._assume_yes:
            return
        if not click.confirm(question, default=False, err=True):
            raise OperatorError(f"not confirmed: {question.rsplit('. ', 1)[0]}; nothing moved")


class EmulatedOperator:
    """Does at the emulator's pendant what a person does at the arm.

    known : names of the payloads that the emulator has properties of; others are mounted as announced.
    enters_load : whether load data are entered at the pendant; otherwise they go over the link
    """

    def __init__(self, pendant: Pendant, known: frozenset[str], *, enters_load: bool = True) -> None:
        self._pendant = pendant
        self._known = known
        self._enters_load = enters_load

    def swap(self, mounted: Payload | None, wanted: Payload | None) -> None:
        """Mount or unmount, and enter the announced load data."""
        if wanted is None:
            self._pendant.unmount()
            if self._enters_load:
                self._pendant.set_load(0.0)
            return
        if wanted.name in self._known:
            self._pendant.mount(wanted.name)
        else:
            self._pendant.mount(mass=wanted.mass, com=wanted.com, inertia=wanted.inertia)
        if self._enters_load:
            self._pendant.set_load(wanted.mass, wanted.com, wanted.inertia)

    def start_trace(self) -> None:
        """Begin the controller's trace."""
        self._pendant.start_trace()

    def save_trace(self, path: Path) -> bool:
        """Save the controller's trace."""
        self._pendant.save_trace(path)
        return True
