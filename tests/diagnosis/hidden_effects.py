"""Physics hidden in the emulator through its plug-ins; nothing of the diagnosis is in here."""

from __future__ import annotations

import math

import numpy as np

from sim_backend.plant import Effect, Loads, Plant, Reading


class SlowGrip(Effect):
    """Lubricant film that breaks down at low speed: more Coulomb friction in the drive, a bell over the speed."""

    def __init__(self, joint: int, amplitude: float, speed: float) -> None:
        self.joint, self.amplitude, self.speed = joint - 1, amplitude, speed

    def load(self, time_s: float, plant: Plant, loads: Loads) -> None:
        ratio = plant.motor_velocity[self.joint] / self.speed
        loads.Fcm[self.joint] += self.amplitude * math.exp(-(ratio**2))


class Hose(Effect):
    """A hose along the arm that pulls the link back, harder the further it is bent."""

    def __init__(self, joint: int, stiffness: float, rest: float = 0.0) -> None:
        self.joint, self.stiffness, self.rest = joint - 1, stiffness, rest

    def load(self, time_s: float, plant: Plant, loads: Loads) -> None:
        bend = plant.position[self.joint] - self.rest
        loads.link_torque[self.joint] -= self.stiffness * bend


class Bristles(Effect):
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


class WrongGain(Effect):
    """A joint torque sensor or a torque constant with a wrong scale."""

    def __init__(self, joint: int, motor: float = 0.0, sensor: float = 0.0) -> None:
        self.joint, self.motor, self.sensor = joint - 1, motor, sensor

    def sense(self, time_s: float, plant: Plant, reading: Reading) -> None:
        reading.joint_torque[self.joint] *= 1.0 + self.sensor

    def sense_motor(self, time_s: float, plant: Plant, reading: Reading) -> None:
        reading.motor_torque[self.joint] *= 1.0 + self.motor


class LoadGrip(Effect):
    """Teeth that are pressed together by what they transmit: friction grows with the joint torque."""

    def __init__(self, joint: int, factor: float) -> None:
        self.joint, self.factor = joint - 1, factor

    def load(self, time_s: float, plant: Plant, loads: Loads) -> None:
        loads.Fcm[self.joint] += self.factor * float(np.abs(plant.joint_torque[self.joint]))
