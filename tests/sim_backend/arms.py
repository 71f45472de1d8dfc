"""Small arms for the tests of the emulator's physics."""

import dataclasses

import numpy as np
import pinocchio as pin

from sim_backend.configuration import load_configuration
from sim_backend.plant import ElasticArm
from sim_backend.robot import Drive, robot_file, true_arm


def drive(joints=1, **values):
    """Drives without friction; every keyword replaces a row."""
    rows = {name: np.zeros(joints) for name in ("Fvl", "Fcl", "offl", "Fvm", "Fcm", "offm", "damping")}
    rows |= {"Ia": np.ones(joints), "stiffness": np.full(joints, 1e4), "brake_torque": np.full(joints, 100.0)}
    rows |= {name: np.broadcast_to(np.asarray(value, float), joints).copy() for name, value in values.items()}
    return Drive(**rows)


def pendulum(inertia=1.0, mass=0.0, length=0.0, gravity=9.81):
    """One joint about the horizontal y axis; the centre of mass hangs `length` below it at zero."""
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelRY(), pin.SE3.Identity(), "swing")
    about_centre = np.diag([inertia, inertia - mass * length**2, inertia])
    model.appendBodyToJoint(
        joint, pin.Inertia(mass, np.array([0.0, 0.0, -length]), about_centre), pin.SE3.Identity()
    )
    model.gravity.linear = np.array([0.0, 0.0, -gravity])
    return model


def lwr(payload=None, frictionless=False, **settings):
    """The default emulated arm as a plant."""
    config = load_configuration()
    content = robot_file(config)
    model, drives = true_arm(config, content)
    if frictionless:
        zero = np.zeros(7)
        names = ("Fvl", "Fcl", "offl", "Fvm", "Fcm", "offm", "damping")
        drives = dataclasses.replace(drives, **dict.fromkeys(names, zero))
    arm = ElasticArm(model, drives, **settings)
    arm.mount(content.payload(payload or "none"))
    return arm


def stored_energy(arm):
    """Kinetic energy of links and motors, potential energy, energy in the elastic joints [J]."""
    data = arm.model.createData()
    links = pin.computeKineticEnergy(arm.model, data, arm.position, arm.velocity)
    height = pin.computePotentialEnergy(arm.model, data, arm.position)
    motors = 0.5 * arm.drive.Ia @ arm.motor_velocity**2
    torsion = 0.5 * arm.drive.stiffness @ (arm.motor_position - arm.position) ** 2
    return links + height + motors + torsion
