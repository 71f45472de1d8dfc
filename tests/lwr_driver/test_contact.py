"""The watch of torque and contact: its estimate of the external torque, and its limits."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from fri.errors import ConfigurationError
from lwr_driver.contact import EXTERNAL_NM, Contact, ContactSettings, ContactWatch, ExpectedArm
from tests.lwr_driver.contact_rig import HOME, NOTHING, Floats, follow, swing
from tests.lwr_driver.driver_rig import arm

LOAD = pin.Inertia(3.34, np.array([0.0, -0.066, 0.066]), np.diag([0.02, 0.02, 0.01]))


def model(load: pin.Inertia | None = None) -> pin.Model:
    links = pin.buildModelFromXML(arm().urdf)
    if load is not None:
        flange = links.frames[links.getFrameId("flange")].placement
        links.appendBodyToJoint(7, load, flange)
    return links


def watch(settings: ContactSettings | None = None, period_s: float = 1e-3) -> ContactWatch:
    made = ContactWatch(ExpectedArm.nominal(arm()), settings or ContactSettings(), arm().tau_max)
    made.set_period(period_s)
    return made


def torques(links: pin.Model, q: Floats, qd: Floats, qdd: Floats) -> Floats:
    data = links.createData()
    return np.array([pin.rnea(links, data, *row) for row in zip(q, qd, qdd, strict=True)])


@pytest.mark.parametrize("period_s", [1e-3, 5e-3, 10e-3])
def test_free_motion_shows_no_external_torque(period_s):
    q, qd, qdd = swing(period_s)
    found, external = follow(watch(period_s=period_s), q, torques(model(), q, qd, qdd))
    assert found == [None] * len(q)
    assert np.abs(external).max() < 2.0


@pytest.mark.parametrize("period_s", [1e-3, 5e-3])
@pytest.mark.parametrize(("joint", "torque"), [(1, 30.0), (5, -8.0)])
def test_a_push_is_found_within_15_ms_with_its_size_and_sign(period_s, joint, torque):
    q, qd, qdd = swing(period_s)
    tau = torques(model(), q, qd, qdd)
    first = round(1.0 / period_s)
    tau[first:, joint] -= torque
    found, external = follow(watch(period_s=period_s), q, tau)
    told = next(row for row, contact in enumerate(found) if contact is not None)
    assert 0 <= told - first <= round(15e-3 / period_s)
    contact = found[told]
    assert contact is not None
    assert (contact.joint, contact.quantity) == (joint, "external torque by the model")
    assert contact.value > contact.limit
    assert external[-1, joint] == pytest.approx(torque, abs=1.0)


def test_the_payload_belongs_to_the_arm_once_it_is_known():
    q, qd, qdd = swing(1e-3)
    tau = torques(model(LOAD), q, qd, qdd)
    assert any(follow(watch(), q, tau)[0])
    told = watch()
    told.carry(LOAD.mass, LOAD.lever, np.diag(LOAD.inertia))
    found, external = follow(told, q, tau)
    assert not any(found)
    assert np.abs(external).max() < 2.5


def test_an_untold_payload_follows_from_the_controllers_gravity_torque():
    q, qd, qdd = swing(1e-3)
    gravity = torques(model(LOAD), q, 0.0 * qd, 0.0 * qdd)
    made = watch()
    follow(made, q[:1], torques(model(LOAD), q[:1], qd[:1], qdd[:1]), gravity=gravity[:1])
    made.weigh()
    found, external = follow(made, q, torques(model(LOAD), q, qd, qdd), gravity=gravity)
    assert not any(found)
    assert np.abs(external).max() < 4.0


def test_known_friction_is_no_contact_and_its_sign_at_rest_is_left_open():
    q, qd, qdd = swing(1e-3)
    coulomb, viscous = np.full(7, 3.0), np.full(7, 2.0)
    tau = torques(model(), q, qd, qdd) + coulomb * np.sign(qd) + viscous * qd + 1.0
    nominal = ExpectedArm.nominal(arm())
    known = ExpectedArm(nominal.dynamics, tuple(viscous), tuple(coulomb), (1.0,) * 7, (0.5,) * 7)
    made = ContactWatch(known, ContactSettings(external_nm=(1.5,) * 7), arm().tau_max)
    found, external = follow(made, q, tau)
    assert not any(found)
    assert np.abs(external[500:]).max() < 4.0
    made.update(1, *(np.zeros(7, np.float32) for _ in range(4)))
    assert np.all(made.allowed >= 2.0 - 1e-9)
    assert any(
        follow(ContactWatch(nominal, ContactSettings(external_nm=(1.5,) * 7), arm().tau_max), q, tau)[0]
    )


def test_the_controllers_estimate_counts_by_itself():
    q = np.tile(HOME, (100, 1))
    tau = torques(model(), q, 0.0 * q, 0.0 * q)
    estimate = np.zeros_like(q)
    # As it grows: a jump of one packet is not believed.
    estimate[50:, 4] = -np.minimum(np.arange(50), 30.0)
    found, _ = follow(watch(), q, tau, estimate)
    assert found[58] is None
    assert found[60] is not None
    assert (
        found[60]
        .describe(arm().joint_names)
        .startswith("A4 external torque by the controller's estimate 10.0 Nm exceeds 9.0 Nm")
    )


def test_joint_torque_near_its_limit_is_told_without_any_torque_before():
    made = watch()
    q = np.tile(HOME, (50, 1))
    tau = np.zeros_like(q)
    tau[20:, 1] = -400.0
    found, _ = follow(made, q, tau)
    # The second packet confirms the jump.
    assert found[20] is None
    assert found[21] == Contact("joint torque", 1, 400.0, pytest.approx(0.9 * 176.0))


def test_torque_channel_without_a_value_is_no_contact():
    q, _, _ = swing(1e-3)
    found, external = follow(watch(), q, 0.0 * q)
    assert not any(found)
    assert not external.any()


def test_a_flipped_bit_in_one_packet_is_no_contact():
    q, qd, qdd = swing(1e-3)
    tau = torques(model(), q, qd, qdd)
    q[700, 3] += 0.5
    tau[900, 1] = 900.0
    found, external = follow(watch(), q, tau)
    assert not any(found)
    assert np.abs(external).max() < 3.0


@pytest.mark.parametrize("period_s", [1e-3, 5e-3])
@pytest.mark.parametrize("second", [1, 3])
def test_damaged_packets_in_a_row_are_forgotten(period_s, second):
    q, qd, qdd = swing(period_s)
    tau = torques(model(), q, qd, qdd)
    row = round(0.7 / period_s)
    q[row, 3] += 0.5
    q[row + 1, second] += 2.0**-7
    _, external = follow(watch(period_s=period_s), q, tau)
    assert np.abs(external[:row]).max() < 3.0
    assert np.abs(external[row + round(0.1 / period_s) :]).max() < 3.0


def test_arm_at_rest_after_damaged_packets_is_quiet():
    q = np.tile(HOME, (60, 1))
    q[20:22, 1] += 2.0**-7
    tau = torques(model(), q, 0.0 * q, 0.0 * q)
    found, external = follow(watch(period_s=5e-3), q, tau)
    assert not any(found[35:])
    assert np.abs(external[40:]).max() < 1.0


def test_a_damaged_packet_in_the_beginning_is_no_contact():
    q, qd, qdd = swing(1e-3)
    tau = torques(model(), q, qd, qdd)
    q[0, 3] += 0.5
    found, external = follow(watch(), q, tau)
    assert not any(found)
    assert np.abs(external).max() < 3.0


def test_a_damaged_gravity_torque_is_no_contact_and_no_payload():
    q, qd, qdd = swing(1e-3)
    gravity = torques(model(), q, 0.0 * qd, 0.0 * qdd)
    tau = torques(model(), q, qd, qdd)
    made = watch()
    wrong = gravity.copy()
    wrong[700, 1] -= 40.0
    found, external = follow(made, q[:701], tau, gravity=wrong)
    made.weigh()
    more, later = follow(made, q[701:], tau[701:], gravity=gravity[701:])
    assert not any(found + more)
    assert max(np.abs(external).max(), np.abs(later).max()) < 3.0


@pytest.mark.parametrize(
    ("period_s", "lost"), [(1e-3, range(3, 6)), (10e-3, range(3, 6)), (5e-3, range(8, 14))]
)
def test_lost_packets_are_bridged(period_s, lost):
    q, qd, qdd = swing(period_s)
    tau = torques(model(), q, qd, qdd)
    made, last = watch(period_s=period_s), 0
    for row in range(len(q)):
        if row % (lost.stop + 1) in lost:
            continue
        contact = made.update(
            row - last if row else 1, q[row].astype(np.float32), tau[row].astype(np.float32), NOTHING, NOTHING
        )
        assert contact is None
        last = row
        # A constant acceleration over the gap errs by the jerk.
        assert np.abs(made.external).max() < (3.0 if period_s == 1e-3 else 7.0)


@pytest.mark.parametrize("period_s", [1e-3, 2e-3, 5e-3, 10e-3])
@pytest.mark.parametrize("whole", [True, False])
def test_a_frozen_measurement_is_told_as_stale_and_no_contact(period_s, whole):
    q, qd, qdd = swing(period_s)
    tau = torques(model(), q, qd, qdd)
    first = round(0.7 / period_s)
    frozen = slice(first, first + max(3, round(30e-3 / period_s)))
    q[frozen] = q[first - 1]
    if whole:
        tau[frozen] = tau[first - 1]
    made, stale = watch(period_s=period_s), []
    for row in range(len(q)):
        assert follow(made, q[row : row + 1], tau[row : row + 1])[0] == [None]
        stale.append(made.stale)
    told = next(row for row, each in enumerate(stale) if each is not None)
    assert told == first + max(3, round(10e-3 / period_s)) - 1
    found = stale[told]
    assert found is not None
    assert abs(found.velocity) == pytest.approx(np.abs(qd[first - 1, found.joint]).max(), rel=0.1)
    assert stale[frozen.stop] is None


@pytest.mark.parametrize("period_s", [1e-3, 5e-3])
def test_a_position_repeated_for_a_packet_or_two_is_bridged(period_s):
    q, qd, qdd = swing(period_s)
    tau = torques(model(), q, qd, qdd)
    for row in range(20, len(q) - 2, 25):
        q[row : row + 2] = q[row - 1]
    made = watch(period_s=period_s)
    found, external = follow(made, q, tau)
    assert found == [None] * len(q)
    assert np.abs(external).max() < 6.0


def test_a_push_is_found_while_the_position_is_repeated():
    q, qd, qdd = swing(1e-3)
    tau = torques(model(), q, qd, qdd)
    estimate = np.zeros_like(q)
    q[700:705], estimate[700:, 1] = q[699], 30.0
    found, _ = follow(watch(), q, tau, estimate)
    told = next(row for row, contact in enumerate(found) if contact is not None)
    assert told <= 706


def test_an_arm_at_rest_does_not_repeat_its_position():
    q = np.tile(HOME, (1500, 1))
    q[:100, 0] += 1e-3 * np.arange(-100, 0)
    tau = torques(model(), q, 0.0 * q, 0.0 * q)
    made = watch()
    follow(made, q[:1200], tau[:1200])
    assert made.stale is None
    assert not any(follow(made, q[1200:], tau[1200:])[0])


def test_packets_lost_for_longer_in_motion_are_no_contact():
    q, qd, qdd = swing(1e-3)
    tau = torques(model(), q, qd, qdd)
    made = watch()
    assert not any(follow(made, q[:700], tau[:700])[0])
    row = [value.astype(np.float32) for value in (q[740], tau[740])]
    assert made.update(41, *row, NOTHING, NOTHING) is None
    found, external = follow(made, q[741:], tau[741:])
    assert not any(found)
    assert np.abs(external).max() < 6.0


def test_an_estimate_that_is_no_number_is_a_contact():
    q = np.tile(HOME, (60, 1))
    tau = torques(model(), q, 0.0 * q, 0.0 * q)
    estimate = np.zeros_like(q)
    estimate[50:, 2] = np.nan
    found, _ = follow(watch(), q, tau, estimate)
    assert found[49] is None
    assert found[-1] is not None
    assert found[-1].joint == 2


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"torque_share": 0.95}, "torque_share 0.95 .* can only be lowered"),
        ({"torque_share": 0.0}, "torque_share 0.0"),
        ({"torque_share": float("nan")}, "torque_share nan"),
        ({"external_nm": (16.0, *EXTERNAL_NM[1:])}, "joint 1 is 16.0 Nm, outside 0 to 15 Nm; .* lowered"),
        ({"external_nm": (*EXTERNAL_NM[:6], -1.0)}, "joint 7 is -1.0 Nm"),
        ({"external_nm": (1.0,) * 6}, "has 6 entries"),
    ],
)
def test_limits_can_only_be_lowered(settings, words):
    with pytest.raises(ConfigurationError, match=words):
        ContactSettings(**settings)


def test_a_lowered_threshold_finds_a_smaller_push():
    q, qd, qdd = swing(1e-3)
    tau = torques(model(), q, qd, qdd)
    tau[800:, 0] += 9.0
    assert not any(follow(watch(), q, tau)[0])
    found, _ = follow(watch(ContactSettings(external_nm=(6.0, *EXTERNAL_NM[1:]))), q, tau)
    assert any(contact is not None and contact.joint == 0 for contact in found)


@pytest.mark.parametrize("kind", ["plain", "contact", "jump", "repeated", "not a number"])
@pytest.mark.parametrize("friction", [0.0, 3.0])
@pytest.mark.parametrize("weight", [False, True])
def test_many_packets_are_watched_as_single_ones(kind, friction, weight):
    q, qd, qdd = swing(1e-3, 0.4)
    tau = torques(model(), q, qd, qdd)
    tau += friction * (qd + np.clip(qd / 0.02, -1.0, 1.0) + 1.0)
    rest = 0.0 * q
    gravity = torques(model(LOAD), q, rest, rest) * weight
    tau += (gravity - torques(model(), q, rest, rest)) * weight
    at = 300
    if kind == "contact":
        tau[at:, 1] -= 200.0
    elif kind == "jump":
        q[at, 2] += 0.1
    elif kind == "repeated":
        q[at] = q[at - 1]
    elif kind == "not a number":
        tau[at, 4] = np.nan
    seven, nominal = (friction,) * 7, ExpectedArm.nominal(arm())
    expected = ExpectedArm(nominal.dynamics, seven, seven, seven, nominal.uncertainty)
    single, many = (ContactWatch(expected, ContactSettings(), arm().tau_max) for _ in range(2))
    columns = [column.astype(np.float32) for column in (q, tau, 0.0 * tau, gravity)]
    for row in range(250):
        for one in (single, many):
            assert one.update(1, *(column[row] for column in columns)) is None
    ahead = many.ahead(*(column[250:] for column in columns))
    assert ahead.count == (len(q) - 250 if kind == "plain" else at - 250)
    ahead.place(ahead.count)
    for row in range(250, 250 + ahead.count):
        assert single.update(1, *(column[row] for column in columns)) is None
    for name in ("_last", "_step", "_state", "_open", "external", "allowed"):
        assert getattr(many, name).tobytes() == getattr(single, name).tobytes(), name
    for row in range(250 + ahead.count, len(q)):
        found = [one.update(1, *(column[row] for column in columns)) for one in (single, many)]
        assert str(found[0]) == str(found[1])


def test_the_first_packets_are_left_to_single_ones():
    q, qd, qdd = swing(1e-3, 0.05)
    tau = torques(model(), q, qd, qdd).astype(np.float32)
    made, nothing = watch(), np.zeros_like(tau)
    assert made.ahead(q.astype(np.float32), tau, nothing, nothing).count == 0
    made.update(1, q[0].astype(np.float32), tau[0], NOTHING, NOTHING)
    assert made.ahead(q.astype(np.float32), tau, nothing, nothing).count == 0
