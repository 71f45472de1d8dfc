"""Bugs written by hand: a changed term, and the tests that must notice it."""

from __future__ import annotations

from dataclasses import dataclass

_SESSIONS = "tests/runner/experiment/test_sessions.py"
_CAUSES = "tests/ident/effects/test_every_cause.py"
_ESTIMATORS = "tests/ident/estimators/test_estimators.py"
_PACKETS = "tests/fri/test_packets.py"
_STOPPING = "tests/runner/test_stopping.py"
_GUARD = "tests/lwr_driver/test_guard.py"


@dataclass(frozen=True)
class Bug:
    """`old` becomes `new` in `file`; one of `tests` (file::function) must fail."""

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]


def _causes(name: str, file: str, old: str, new: str) -> Bug:
    test = f"{_CAUSES}::test_the_torque_of_the_rows_is_that_of_the_simulation"
    return Bug(name, f"ident/effects/{file}", old, new, (test,))


BUGS: tuple[Bug, ...] = (
    Bug(
        "a payload is swapped on an arm in command mode",
        "runner/experiment.py",
        "            self._require_monitor_mode()\n",
        "",
        (f"{_SESSIONS}::test_an_arm_that_stays_in_command_mode_ends_the_run_before_anybody_is_sent_to_it",),
    ),
    Bug(
        "command mode begins with other load data than announced",
        "lwr_driver/driver.py",
        "        self._check_load()\n        try:\n",
        "        try:\n",
        ("tests/lwr_driver/test_load.py::test_no_command_mode_with_other_load_data_than_announced",),
    ),
    Bug(
        "a factor of zero counts as full speed",
        "lwr_driver/guard.py",
        "(min(factor, 1.0) if sound_factor(factor) else 0.0)",
        "(factor if 0.0 < factor < 1.0 else 1.0)",
        (f"{_GUARD}::test_nothing_moves_with_a_factor_that_no_controller_gives",),
    ),
    Bug(
        "a motion goes on without anybody to stop it",
        "lwr_driver/loop.py",
        "silence > _NOBODY_S",
        "silence > 1e9",
        (
            "tests/lwr_driver/test_loop.py::test_a_motion_stops_within_the_limits_when_the_driver_gives_no_sign_of_life",
        ),
    ),
    Bug(
        "a restart of the controller looks like one cycle",
        "fri/remote.py",
        "            tracker.skip(max(round(away), _RESTART_CYCLES) - 1)\n",
        "",
        ("tests/fri/test_remote.py::test_the_time_of_a_restart_is_a_gap_in_the_numbers",),
    ),
    Bug(
        "the preflight is not enforced",
        "runner/experiment.py",
        "        preflight.enforce()\n",
        "",
        (f"{_SESSIONS}::test_nothing_moves_after_a_failed_check",),
    ),
    Bug(
        "the torques at rest are not compared with gravity",
        "runner/experiment.py",
        "            check_gravity(bench.arm, here),\n",
        "",
        (f"{_SESSIONS}::test_nothing_moves_after_a_failed_check",),
    ),
    Bug(
        "the stops of a session's motion are not checked",
        "runner/planning.py",
        "            *check_stops(arm, collision, motion, plan.payload, margin),\n",
        "",
        (f"{_STOPPING}::test_session_with_a_post_in_the_way_of_its_stops_does_not_move",),
    ),
    Bug(
        "a resumption forgets the payload",
        "runner/experiment.py",
        "self._mounted, self._rest = plan.payload, self._progress.rest(plan.name, plan.payload)",
        "self._rest = self._progress.rest(plan.name, plan.payload)",
        (f"{_SESSIONS}::test_a_resumption_asks_for_the_payload_and_weighs_it",),
    ),
    Bug(
        "a resumption forgets the state at rest",
        "runner/experiment.py",
        "self._mounted, self._rest = plan.payload, self._progress.rest(plan.name, plan.payload)",
        "self._mounted = plan.payload",
        (f"{_SESSIONS}::test_a_resumption_weighs_the_payload_against_the_last_session",),
    ),
    Bug(
        "a payload lost in motion is not noticed",
        "runner/experiment.py",
        "outcome, held = self._still_loaded(plan, here, self._drive(plan, motion))",
        "outcome, held = self._drive(plan, motion), here",
        (f"{_SESSIONS}::test_a_payload_lost_on_the_way_fails_the_session",),
    ),
    Bug(
        "the variances of weighted least squares lose their degrees of freedom",
        "ident/estimators/least_squares.py",
        "        freedom = row_class.factor.rows - share\n",
        "        freedom = float(row_class.factor.rows)\n",
        (f"{_ESTIMATORS}::test_weights_are_inverse_variances_with_the_degrees_of_freedom_of_equation_13",),
    ),
    Bug(
        "the inflation of a HAC interval has the wrong sign",
        "ident/estimators/covariance.py",
        "1.96 + 2.9694 * share",
        "1.96 - 2.9694 * share",
        (f"{_ESTIMATORS}::test_the_intervals_of_a_hac_covariance_are_widened_for_its_bandwidth",),
    ),
    Bug(
        "the share of the blocks in the jackknife is turned over",
        "ident/estimators/covariance.py",
        "(count - 1) / count * (stacked.T @ stacked)",
        "count / (count - 1) * (stacked.T @ stacked)",
        (f"{_ESTIMATORS}::test_jackknife_is_the_scatter_of_estimates_without_a_block",),
    ),
    Bug(
        "couplings of the drives leak into the joint rows",
        "ident/dynamics/structure.py",
        'if side != "joint" and joint in involved else None',
        "if joint in involved else None",
        (
            "tests/ident/dynamics/test_model_structure.py::test_a_coupling_of_the_drives_is_not_seen_at_the_joints",
        ),
    ),
    _causes(
        "the simulated Stribeck effect lowers the friction",
        "friction.py",
        'loads.Fcm[run.joint] += values["amplitude"] * fall',
        'loads.Fcm[run.joint] -= values["amplitude"] * fall',
    ),
    _causes(
        "the cosine of the simulated gear ripple has the wrong sign",
        "drive.py",
        "-= cosine * np.cos(angle) + sine * np.sin(angle)",
        "-= -cosine * np.cos(angle) + sine * np.sin(angle)",
    ),
    _causes(
        "the cosine of the simulated sensor ripple has the wrong sign",
        "channel.py",
        "+= cosine * np.cos(angle) + sine * np.sin(angle)",
        "+= -cosine * np.cos(angle) + sine * np.sin(angle)",
    ),
    _causes(
        "the simulated crosstalk is that of the next joint",
        "channel.py",
        'other = plant.joint_torque[round(run.values["source"]) - 1]',
        'other = plant.joint_torque[round(run.values["source"]) % 7]',
    ),
    Bug(
        "the brakes of the emulated arm have no effect",
        "sim_backend/plant.py",
        "self.drive.Fcm + (self.drive.brake_torque if engaged else 0.0)",
        "self.drive.Fcm + 0.0",
        ("tests/sim_backend/test_arm.py::test_a_brake_holds_up_to_its_torque_and_lets_go_when_it_opens",),
    ),
    Bug(
        "the guard allows ten times the rounding of the jerk",
        "lwr_driver/guard.py",
        "3.0 * (a_error + self._a_error) / three",
        "30.0 * (a_error + self._a_error) / three",
        (f"{_GUARD}::test_each_limit_is_widened_by_the_rounding_and_nothing_else",),
    ),
    Bug(
        "the check of a motion allows ten times the rounding",
        "lwr_driver/motion.py",
        "slack = 2.0**order * ROUNDING / period**order",
        "slack = 10.0 * 2.0**order * ROUNDING / period**order",
        (
            "tests/lwr_driver/test_motion.py::"
            "test_limits_are_widened_by_the_rounding_of_a_difference_and_nothing_else",
        ),
    ),
    Bug(
        "the period of the measurements is not checked",
        "fri/packets.py",
        "            or not 0.0009 < measuring < 0.1001\n",
        "",
        (f"{_PACKETS}::test_damaged_field_is_named",),
    ),
    Bug(
        "the bound of the torques is a hundred times too wide",
        "fri/packets.py",
        "math.sqrt(JOINTS) * 1000.0",
        "math.sqrt(JOINTS) * 100_000.0",
        (f"{_PACKETS}::test_torques_beyond_the_sensors_are_refused_and_full_scale_of_all_joints_is_not",),
    ),
    Bug(
        "the bound of the positions is a hundred times too wide",
        "fri/packets.py",
        "math.sqrt(3 * JOINTS) * 2 * math.pi",
        "math.sqrt(3 * JOINTS) * 200 * math.pi",
        (f"{_PACKETS}::test_positions_of_more_than_a_turn_are_refused_and_a_turn_of_all_joints_is_not",),
    ),
    Bug(
        "a stretch shorter than a mean of its samples is kept",
        "ident/rows/prepare.py",
        "        if not enough(len(joint.times), joint.period_s, settings.decimate):\n            continue\n",
        "",
        (
            "tests/ident/rows/test_prepare.py::"
            "test_a_stretch_of_a_few_samples_between_gaps_gives_no_row_and_no_error",
        ),
    ),
    Bug(
        "samples of a frozen position stay in the rows",
        "ident/rows/prepare.py",
        "| seen.stale | unseen",
        "| seen.stale",
        ("tests/ident/screening/test_screen.py::test_samples_of_a_short_freeze_have_no_part_in_the_rows",),
    ),
    Bug(
        "a copy of a log of the estimate is held out",
        "ident/estimation/validate.py",
        "or by_file or alike)",
        "or by_file)",
        (
            "tests/ident/estimation/test_validation_of_models.py::"
            "test_a_copy_of_a_session_of_the_estimate_is_no_held_out_one",
        ),
    ),
    Bug(
        "a torque that is a copy of another joint's is not named",
        "ident/screening/channels.py",
        "        found += [*_copied(session), *_both_sides(session)]\n",
        "        found += [*_both_sides(session)]\n",
        ("tests/ident/screening/test_screen.py::test_a_torque_that_is_a_copy_of_another_joints_is_an_error",),
    ),
    Bug(
        "rows are built across a jump of a position",
        "ident/rows/prepare.py",
        "longest_bridge_s, jumps)",
        "longest_bridge_s)",
        ("tests/ident/rows/test_prepare.py::test_no_row_is_built_across_a_jump_of_a_position",),
    ),
    Bug(
        "an angle that wraps stays so at import",
        "ident/import_log/channels.py",
        "        values, wraps = unwrapped(values)\n",
        "        pass\n",
        (
            "tests/ident/import_log/test_import_log.py::"
            "test_an_angle_that_wraps_is_unwrapped_and_a_jump_is_told",
        ),
    ),
    Bug(
        "a few bad samples decide whether a velocity is dq/dt",
        "ident/import_log/rates.py",
        "    kept = left <= np.quantile(left, 1.0 - _WORST)\n",
        "    kept = left <= np.inf\n",
        ("tests/ident/import_log/test_guess.py::test_velocities_stay_beside_a_hole_a_jump_and_a_wrap",),
    ),
    Bug(
        "a motor torque that is a copy of the joint torque is not named",
        "ident/screening/channels.py",
        "        found += [*_copied(session), *_both_sides(session)]\n",
        "        found += [*_copied(session)]\n",
        (
            "tests/ident/screening/test_screen.py::"
            "test_motor_torques_that_are_a_copy_of_the_joint_torques_are_named",
        ),
    ),
    Bug(
        "each bag is a robot of its own, by the name of its file",
        "ident/import_log/direct.py",
        '"" if robot is None else robot.name',
        "source.stem",
        ("tests/ident/import_log/test_rests.py::test_a_bag_has_the_name_of_its_description_or_none",),
    ),
    Bug(
        "the positions' low-pass smears reversals over the rows of a delay",
        "ident/rows/signal_choice.py",
        "    factor = max(widest / settings.decimate, 1.0)\n",
        "    factor = 1.0\n",
        (
            "tests/ident/estimation/test_delays_from_model.py::"
            "test_a_drive_that_gives_way_at_reversals_looks_neither_late_nor_early",
        ),
    ),
    Bug(
        "a late channel is dropped for slow rows with the reversals in them",
        "ident/diagnosis/verdict/late_channels.py",
        "    if told is not None:\n        return told\n    bench.evidence.replace([])\n",
        "    bench.evidence.replace([])\n",
        (
            "tests/ident/diagnosis/test_motor_torques_alone.py::"
            "test_a_late_channel_is_held_against_rows_away_from_reversals_where_these_tell_it",
        ),
    ),
    Bug(
        "all statements of a cycle read the motor currents at its end",
        "sim_backend/cabinet.py",
        "measured[number - milliseconds]",
        "measured[-1]",
        (
            "tests/sim_backend/test_programs.py::test_a_statement_reads_the_motor_currents_of_its_own_millisecond",
        ),
    ),
    Bug(
        "errors of the torque channels are left out of the stated deviations",
        "ident/estimation/channel_errors.py",
        "stated.matrix + found.spread",
        "stated.matrix",
        (
            "tests/ident/estimation/test_channel_errors.py::"
            "test_the_deviations_hold_with_channels_off_by_a_per_cent",
        ),
    ),
)
