"""The emulated arm against theory."""

from __future__ import annotations

from typing import Any

from benchmarks.trust.gathered import gather
from benchmarks.trust.table import Ledger

__all__ = ["campaign"]

_ARM, _JOINTS, _SENSORS = (
    "sim_backend/test_arm.py",
    "sim_backend/test_joints.py",
    "sim_backend/test_sensors.py",
)
_LINES = {
    "energy balance": [f"{_ARM}::test_energy_in_is_stored_or_dissipated_and_the_error_shrinks_with_the_step"],
    "static torque is gravity": [
        f"{_ARM}::test_static_joint_torque_is_gravity_and_offset",
        f"{_ARM}::test_payload_changes_the_static_torque_by_its_weight",
    ],
    "half the step": [f"{_ARM}::test_halving_the_step_changes_nothing_that_matters"],
    "two-mass resonance": [
        f"{_JOINTS}::test_free_two_mass_mode_is_where_theory_puts_it",
        f"{_JOINTS}::test_wrist_mode_converges_with_the_step",
        f"{_JOINTS}::test_damping_of_the_free_mode_is_where_theory_puts_it",
    ],
    "friction sticks": [
        f"{_JOINTS}::test_rest_stays_at_rest_bit_for_bit",
        f"{_JOINTS}::test_motor_breaks_away_at_the_coulomb_torque",
        f"{_JOINTS}::test_link_sticks_on_a_slowly_turning_motor_until_the_spring_pulls_harder",
        f"{_JOINTS}::test_sliding_friction_is_coulomb_plus_viscous_plus_offset",
        f"{_JOINTS}::test_coulomb_friction_stops_a_sliding_mass_after_the_right_distance",
    ],
    "pendulum and brakes": [
        f"{_JOINTS}::test_free_swing_has_the_period_of_the_physical_pendulum",
        f"{_JOINTS}::test_brakes_hold_the_arm_without_drift",
    ],
    "controller tracks": [
        f"{_SENSORS}::test_controller_tracks_within_a_few_milliradians",
        f"{_SENSORS}::test_wrong_load_data_makes_the_arm_sag_and_right_data_lifts_it",
    ],
    "same seed, same bits": [f"{_ARM}::test_the_same_start_gives_the_same_bits"],
}


def campaign(ledger: Ledger, options: Any) -> None:
    """A line for each law."""
    gather(ledger, "physics", _LINES)
