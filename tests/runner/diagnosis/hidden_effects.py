"""Physics hidden in the emulator through its plug-ins; nothing of the diagnosis is in here."""

from __future__ import annotations

import math

from sim_backend.plant import Loads, Plant, PlantEffect, Reading


class Bristles(PlantEffect):
    """Bristles between the drive's surfaces, which bend before they slide (Dahl), besides Coulomb friction."""

    def __init__(self, joint: int, amplitude: float, length: float) -> None:
        self.joint, self.amplitude, self.length = joint - 1, amplitude, length
        self.bend = 0.0
        self.before: float | None = None

    def load(self, time_s: float, plant: Plant, loads: Loads) -> None:
        here = float(plant.motor_position[self.joint])
        step = 0.0 if self.before is None else here - self.before
        self.before = here
        if step:
            target = math.copysign(1.0, step)
            self.bend = target + (self.bend - target) * math.exp(-abs(step) / self.length)
        loads.motor_torque[self.joint] -= self.amplitude * self.bend


class WrongGain(PlantEffect):
    """A joint torque sensor or a torque constant with a wrong scale."""

    def __init__(self, joint: int, motor: float = 0.0, sensor: float = 0.0) -> None:
        self.joint, self.motor, self.sensor = joint - 1, motor, sensor

    def sense(self, time_s: float, plant: Plant, reading: Reading) -> None:
        reading.joint_torque[self.joint] *= 1.0 + self.sensor

    def sense_motor(self, time_s: float, plant: Plant, reading: Reading) -> None:
        reading.motor_torque[self.joint] *= 1.0 + self.motor
