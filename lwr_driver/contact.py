"""Torque and contact, watched in every cycle.

Compared with limits, joint by joint: the measured joint torque, the controller's estimate of the external torque, and
the driver's own. The own estimate is the torque by which the joint torque sensors miss the model of the arm
with its payload,

    tau_ext = F[M(q) qdd + c(q, qd) + g(q) + Fv qd + Fc sign(qd) + off] - F[tau],

with positions and torques through one second-order low-pass F, of which velocity and acceleration are states
(bilinear transform). Equal delays cancel, and the link's own acceleration is seen as well: a push shows before
it has passed the elastic joint. It follows the measured arm, whatever is commanded.

The limit is a threshold, plus the uncertainty of the friction: its sign below `_SIGN_SPEED`, and its size.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from fri.packets import leading
from fri.quantities import within
from lwr_driver.arm import JOINTS, Arm

Joints = tuple[float, float, float, float, float, float, float]
Floats = NDArray[np.float64]

EXTERNAL_NM: Joints = (15.0, 15.0, 8.0, 8.0, 8.0, 3.5, 3.5)
"""Highest thresholds of the external torque [Nm], about a twelfth of the joints' limits."""

_Threshold = Annotated[float, within(0.0, max(EXTERNAL_NM), "Nm", above=True)]
Thresholds = tuple[_Threshold, _Threshold, _Threshold, _Threshold, _Threshold, _Threshold, _Threshold]

TORQUE_SHARE = 0.9
"""Highest share of a joint's torque limit."""

# Link-side friction of the nominal arm, unknown and below this share of the torque limit.
_FRICTION_SHARE = 0.01
_SIGN_SPEED = 0.02  # of a joint: below it the sign of its friction is uncertain [rad/s]
_CUTOFF_HZ, _DAMPING = 40.0, 0.8
_LARGEST_ANGLE = 1.2  # of the cutoff frequency, per cycle [rad]
_SETTLING = 5.0  # time constants of F after a beginning
_MOST_CYCLES = 10  # after a longer gap F begins anew
_BEYOND_FLANGE_M = 0.05
_FARTHEST_M = 0.6  # of a centre of mass from the wrist
_MOST_KG = 50.0
_LEAST_KG = 0.3  # smaller differences of the gravity torque are no payload
# Jumps between two packets, believed with the second packet: of the position by more than an acceleration makes.
_JUMP_RAD, _JUMP_RAD_S2, _JUMP_SHARE = 5e-3, 20.0, 0.5
_FASTEST_RAD_S = 4.0  # a joint is slower
# A position repeated to the last bit is stale if its joint was faster than braking to rest in one packet allows.
_REPEATED_RAD, _BRAKING_RAD_S2 = 5e-5, 10.0
_STALE_S, _STALE_PACKETS = 10e-3, 3
_AT_REST_S = 0.1  # repeated for so long, it is at rest


@dataclass(frozen=True)
class ContactSettings:
    """Limits of torque and contact; they can be lowered, not raised.

    torque_share : largest joint torque, as a share of the joint's limit
    external_nm : thresholds of the external torque [Nm], by the controller's estimate and by the model
    """

    torque_share: Annotated[float, within(0.0, TORQUE_SHARE, above=True)] = TORQUE_SHARE
    external_nm: Thresholds = EXTERNAL_NM

    def __post_init__(self) -> None:
        if not 0.0 < self.torque_share <= TORQUE_SHARE:
            raise ConfigurationError(
                f"torque_share {self.torque_share} is outside 0 to {TORQUE_SHARE}; it can only be lowered"
            )
        if len(self.external_nm) != JOINTS:
            raise ConfigurationError(f"external_nm has {len(self.external_nm)} entries, the arm {JOINTS}")
        for joint, (value, most) in enumerate(zip(self.external_nm, EXTERNAL_NM, strict=True), start=1):
            if not 0.0 < value <= most:
                raise ConfigurationError(
                    f"external_nm of joint {joint} is {value} Nm, outside 0 to {most:g} Nm; it can only be lowered"
                )


@dataclass(frozen=True)
class ExpectedArm:
    """The arm without payload as the own estimate expects it; (7,) each.

    dynamics : rigid bodies, a pinocchio model as text
    viscous [Nm s/rad], coulomb [Nm], offset [Nm] : friction at the joint torque sensor
    uncertainty : of friction and offset [Nm]
    """

    dynamics: str
    viscous: tuple[float, ...]
    coulomb: tuple[float, ...]
    offset: tuple[float, ...]
    uncertainty: tuple[float, ...]

    @classmethod
    def nominal(cls, arm: Arm) -> ExpectedArm:
        """Bodies of the URDF, friction unknown."""
        import pinocchio as pin

        zero = (0.0,) * JOINTS
        uncertainty = tuple((_FRICTION_SHARE * arm.tau_max).tolist())
        return cls(pin.buildModelFromXML(arm.urdf).saveToString(), zero, zero, zero, uncertainty)


class Contact(NamedTuple):
    """A limit exceeded: quantity, joint from 0, size and limit [Nm]."""

    quantity: str
    joint: int
    value: float
    limit: float

    def describe(self, joint_names: tuple[str, ...]) -> str:
        """The message with subject, value and limit."""
        name = joint_names[self.joint]
        digits = 1 if self.value > self.limit + 0.1 else 3
        return f"{name} {self.quantity} {self.value:.{digits}f} Nm exceeds {self.limit:.{digits}f} Nm"

    @property
    def advice(self) -> str:
        """The remedy."""
        if self.quantity == _QUANTITIES[0]:
            return "free the arm, or slow the motion down"
        return "free the arm; if nothing touches it, check its payload, load data and torque sensors"


class Stale(NamedTuple):
    """A measured position that has stopped to change in motion: joint from 0, time [s], velocity before [rad/s]."""

    joint: int
    seconds: float
    velocity: float

    def describe(self, joint_names: tuple[str, ...]) -> str:
        """The message with subject, value and advice."""
        return (
            f"stale measurement: {joint_names[self.joint]} measured position has not changed for {self.seconds:.3f} s "
            f"at {abs(self.velocity):.2f} rad/s"
        )

    @property
    def advice(self) -> str:
        """The remedy."""
        return "the controller repeats old values; look at the pendant, and try a longer cycle of friOpen"


_QUANTITIES = ("joint torque", "external torque by the controller's estimate", "external torque by the model")


class ContactWatch:
    """Compares each packet with the limits.

    expected : the arm; settings : its limits; tau_max : torque limits of the joints (7,) [Nm]

    external : own estimate of the external torque (7,) [Nm], positive if it drives the joint forward; zero if unknown
    allowed : its limit at present (7,) [Nm]
    stale : a measured position repeated in several packets of a motion; None if there is none

    A position repeated to the last bit at speed counts as a lost packet: no obstacle stops a joint so, its elastic
    joint goes on. Joint torque and the controller's estimate are watched meanwhile.

    The payload is known from `carry`. Otherwise its weight is taken from the packet's gravity torque, the controller's
    load data, and the inertia that belongs to this weight from `weigh`. A channel of joint torques all exactly zero
    since the beginning is none: then only the controller's estimate counts.
    """

    def __init__(self, expected: ExpectedArm, settings: ContactSettings, tau_max: Floats) -> None:
        import pinocchio as pin

        self._pin = pin
        self._model = pin.Model()
        self._model.loadFromString(expected.dynamics)
        self._data = self._model.createData()
        self._bare = self._model.inertias[JOINTS].copy()
        named = self._model.existFrame("flange")
        frame = self._model.frames[self._model.getFrameId("flange")] if named else None
        self._flange = pin.SE3.Identity() if frame is None else frame.placement.copy()
        self._carried = False
        rows = np.array([expected.viscous, expected.coulomb, expected.offset])
        self._viscous, self._coulomb, self._offset = rows
        self._friction = bool(rows.any())
        self._most = settings.torque_share * tau_max
        self._threshold = np.array(settings.external_nm) + np.array(expected.uncertainty)
        self.external = np.zeros(JOINTS)
        self.allowed = self._threshold.copy()
        torque, gravity = _JUMP_SHARE * tau_max, _JUMP_SHARE * np.array(EXTERNAL_NM)
        self._jump = np.concatenate([np.zeros(JOINTS), torque, torque, gravity])
        # Position, torque, the controller's estimate and gravity torque.
        self._now, self._last, self._doubtful = (np.zeros(4 * JOINTS) for _ in range(3))
        # Views of the two buffers that take turns as the packet of now: its four parts, and both joint torques.
        self._parts = tuple(_parts(packet) for packet in (self._now, self._last))
        self._step, self._change, self._odd = (np.zeros(4 * JOINTS) for _ in range(3))
        self._calm = np.zeros(4 * JOINTS, dtype=bool)
        self._bend = np.zeros(2 * JOINTS)  # of the way over lost packets, against the last velocity
        # Position and velocity of the low-pass, and its input.
        self._filter, self._next = np.zeros((3, 2 * JOINTS)), np.zeros((2, 2 * JOINTS))
        self._state, self._input = self._filter[:2], self._filter[2]
        self._excess = np.full((3, JOINTS), -np.inf)
        self._known = False
        self.stale: Stale | None = None
        self._repeats, self._unmeasured = 0, 0  # packets on end, and their cycles
        self._open = np.ones(JOINTS)  # share of the friction of uncertain sign
        self._doubted = False
        self._alive = False
        self._settling = 0
        self.set_period(1e-3)

    def set_period(self, period_s: float) -> None:
        """Begin with packets of this period [s]."""
        cutoff = min(2.0 * np.pi * _CUTOFF_HZ, _LARGEST_ANGLE / period_s)
        self._square, self._double = cutoff**2, 2.0 * _DAMPING * cutoff
        rates = np.array([[0.0, 1.0], [-self._square, -self._double]])
        half = 0.5 * period_s
        inverse = np.linalg.inv(np.eye(2) - half * rates)
        forced = half * np.array([[0.0], [self._square]])
        self._advance = inverse @ np.hstack([np.eye(2) + half * rates, forced])
        self._lag = 2.0 * _DAMPING / cutoff
        self._closing = np.exp(-0.5 * cutoff * period_s)
        self._settled = int(np.ceil(_SETTLING / (cutoff * period_s)))
        self._fastest = _FASTEST_RAD_S * period_s
        self._period, self._slowest = period_s, _REPEATED_RAD + _BRAKING_RAD_S2 * period_s**2
        self._jump[:JOINTS] = _JUMP_RAD + _JUMP_RAD_S2 * period_s**2
        self._known = False

    def carry(self, mass: float, com: Floats, inertia: Floats) -> None:
        """Expect a payload: mass [kg], centre of mass in the flange frame [m], JX JY JZ about it [kg m2]."""
        pin, model = self._pin, self._model
        body = pin.Inertia(mass, com, np.diag(inertia))
        model.inertias[JOINTS] = self._bare + self._flange.act(body)
        self._carried = True

    def weigh(self) -> None:
        """Mass and centre of mass from the controller's gravity torque in the last packet, unless `carry` told.

        What this pose does not show of the centre of mass is taken for `_BEYOND_FLANGE_M` out of the flange.
        """
        q, gravity = self._last[:JOINTS], self._last[3 * JOINTS :]
        if self._carried or not gravity.any():
            return
        pin, model, zero = self._pin, self._model, np.zeros(JOINTS)
        model.inertias[JOINTS] = self._bare
        load = gravity - pin.computeGeneralizedGravity(model, self._data, q)
        columns = pin.computeJointTorqueRegressor(model, self._data, q, zero, zero)
        columns = columns[:, 10 * (JOINTS - 1) :][:, :4]
        usual = self._flange.act(np.array([0.0, 0.0, _BEYOND_FLANGE_M]))
        # For the mass, and for the deviation of the first moment from that of the usual place.
        columns[:, 0] += columns[:, 1:] @ usual
        mass, *moment = np.linalg.lstsq(columns, load, rcond=0.01)[0]
        centre = usual + np.array(moment) / max(mass, _LEAST_KG)
        # A far centre of mass comes from an arm not at rest, and would have a large inertia.
        if _LEAST_KG < mass < _MOST_KG and float(np.linalg.norm(centre)) < _FARTHEST_M:
            body = pin.Inertia(mass, centre, np.zeros((3, 3)))
            model.inertias[JOINTS] = self._bare + body

    def update(
        self,
        cycles: int,
        q: NDArray[np.float32],
        tau: NDArray[np.float32],
        estimate: NDArray[np.float32],
        gravity: NDArray[np.float32],
    ) -> Contact | None:
        """Take in a packet, `cycles` after the last one; the limit exceeded, if any.

        q [rad], tau [Nm] : measured. estimate, gravity : the controller's external and gravity torques [Nm]; (7,) each
        """
        now, last, change = self._now, self._last, self._change
        parts, others = self._parts
        parts[0][:], parts[1][:], parts[2][:], parts[3][:] = q, tau, estimate, gravity
        if self._known and self._repeated(cycles):
            return self._exceeded(parts[4])
        cycles += self._unmeasured
        self.stale, self._repeats, self._unmeasured = None, 0, 0
        if not self._known or not 0 < cycles <= _MOST_CYCLES:
            gap, cycles = cycles, 1
            self._begin(gap if self._known else 0)
        np.subtract(now, last, out=change)
        self._believe(cycles)
        self._alive = self._alive or bool(parts[1].any())
        self._low_pass(cycles)
        self._settling = max(self._settling - cycles, 0)
        self._estimate(parts[3])
        self._last, self._now = now, last
        self._parts = others, parts
        return self._exceeded(parts[4])

    def _repeated(self, cycles: int) -> bool:
        """Whether this packet repeats the position of a joint at speed."""
        same = (self._now[:JOINTS] == self._last[:JOINTS]) & (np.abs(self._step[:JOINTS]) > self._slowest)
        if not same.any():
            return False
        self._repeats, self._unmeasured = self._repeats + 1, self._unmeasured + cycles
        seconds = self._unmeasured * self._period
        if self._repeats >= _STALE_PACKETS and seconds > _STALE_S - 0.5 * self._period:
            joint = int(np.argmax(np.where(same, np.abs(self._step[:JOINTS]), 0.0)))
            self.stale = Stale(joint, seconds, self._step[joint] / self._period)
        # After so long it rests indeed.
        return seconds < _AT_REST_S

    def _exceeded(self, torques: Floats) -> Contact | None:
        """The limit exceeded by joint torque and controller's estimate (2, 7), or by the own estimate."""
        excess = self._excess
        np.abs(torques, out=excess[:2])
        excess[0] -= self._most
        excess[1] -= self.allowed
        np.abs(self.external, out=excess[2])
        excess[2] -= self.allowed
        # Also false for NaN.
        return None if np.maximum.reduce(excess, axis=None) <= 0.0 else self._contact()

    def _begin(self, cycles: int = 0) -> None:
        """Begin with this packet: at rest, or moving as since the last packet, so many `cycles` before."""
        self._step[:] = 0.0
        if cycles > 0:
            step = (self._now[:JOINTS] - self._last[:JOINTS]) / cycles
            np.clip(step, -self._fastest, self._fastest, out=self._step[:JOINTS])
        self._last[:] = self._now - self._step
        self._filter[1] = self._step[: 2 * JOINTS] / self._period
        self._filter[0] = self._last[: 2 * JOINTS] - self._lag * self._filter[1]
        self._doubted = False
        self._settling, self._known = self._settled, True

    def _believe(self, cycles: int) -> None:
        """Replace a packet with a jump by what the packets before it let expect: a flipped bit is no contact.

        The packet after it is believed, also if it jumps. Then the step between these two is the one to go on with:
        one that includes the jump would make the packets to come seem odd, without an end.
        """
        now, last, step, change, odd = self._now, self._last, self._step, self._change, self._odd
        self._bend[:] = 0.0
        np.multiply(step, -cycles, out=odd)
        odd += change
        np.abs(odd, out=odd)
        allowed = self._jump
        if cycles > 1:
            # A velocity taken for constant errs by the acceleration.
            allowed = allowed.copy()
            allowed[:JOINTS] += _JUMP_RAD_S2 * self._period**2 * (0.5 * cycles * (cycles + 1) - 1.0)
        # Also true for NaN.
        jumps = not np.logical_and.reduce(np.less_equal(odd, allowed, out=self._calm))
        if jumps and not self._doubted:
            self._doubted = True
            self._doubtful[:] = now
            np.multiply(step, cycles, out=change)
            np.add(last, change, out=now)
            return
        self._doubted = False
        if not jumps:
            bend = self._bend[:JOINTS]
            if cycles > 1:
                np.subtract(change[:JOINTS], cycles * step[:JOINTS], out=bend)
            np.divide(change[:JOINTS] + bend, cycles, out=step[:JOINTS])
            return
        moved = (now[:JOINTS] - self._doubtful[:JOINTS]) / cycles
        if self._settling:
            # The packet that F began with was the damaged one.
            self._begin()
            change[:] = 0.0
        np.clip(moved, -self._fastest, self._fastest, out=step[:JOINTS])

    def _low_pass(self, cycles: int) -> None:
        """Advance F from the last packet to this one: positions with a constant acceleration, torques straight."""
        source, ends = self._input, 2 * JOINTS
        change, last = self._change[:ends], self._last[:ends]
        for part in range(cycles):
            np.multiply(change, (2 * part + 1) / cycles, out=source)
            np.add(source, last, out=source)
            np.add(source, last, out=source)
            if cycles > 1:
                # The sum of both ends of the parabola, less that of the straight line.
                source += (part**2 + (part + 1) ** 2 - (2 * part + 1) * cycles) / cycles**2 * self._bend
            self._advance.dot(self._filter, self._next)
            self._state[:] = self._next

    def _estimate(self, gravity: Floats) -> None:
        """The own estimate, from the state of the low-pass."""
        if self._settling or not self._alive:
            self.external[:] = 0.0
            return
        q, tau = self._filter[0, :JOINTS], self._filter[0, JOINTS:]
        qd = self._filter[1, :JOINTS]
        qdd = self._acceleration(q, qd, self._now[:JOINTS])
        expected = self._pin.rnea(self._model, self._data, q, qd, qdd)
        if self._listens and gravity.any():
            expected = expected + gravity - self._weight(q)
        if self._friction:
            friction, unsure = self._frictions(qd, qdd)
            expected = expected + friction
            self._open = np.maximum(unsure, self._closing * self._open)
            np.add(self._threshold, self._coulomb * self._open, out=self.allowed)
        np.subtract(expected, tau, out=self.external)

    def _acceleration(self, q: Floats, qd: Floats, measured: Floats) -> Floats:
        """Acceleration by the low-pass at q, qd for the position `measured`; (..., 7) each."""
        acceleration: Floats = self._square * (measured - q) - self._double * qd
        return acceleration

    @property
    def _listens(self) -> bool:
        """Whether the packet's gravity torque tells the weight of the payload."""
        return not self._carried

    def _weight(self, q: Floats) -> Floats:
        """Gravity torque of the expected bodies (7,)."""
        weight: Floats = self._pin.computeGeneralizedGravity(self._model, self._data, q)
        return weight

    def _frictions(self, qd: Floats, qdd: Floats) -> tuple[Floats, Floats]:
        """Friction with offset, and the share of it with an uncertain sign; (..., 7) each."""
        sign = np.minimum(np.maximum(qd / _SIGN_SPEED, -1.0), 1.0)
        friction = self._viscous * qd + self._coulomb * sign + self._offset
        # A change of sign passes the low-pass gradually.
        turns = qd * (qd + self._lag * qdd) <= 0.0
        return friction, np.where(turns, 1.0, 1.0 - np.abs(sign))

    def ahead(
        self,
        q: NDArray[np.float32],
        tau: NDArray[np.float32],
        estimate: NDArray[np.float32],
        gravity: NDArray[np.float32],
    ) -> WatchAhead:
        """The next packets, each a cycle after the one before it, as `update` would take them; (n, 7) each.

        The result ends before the first packet with a limit exceeded, a jump or a repeated position.
        """
        packets = np.concatenate([q, tau, estimate, gravity], axis=1).astype(np.float64)
        doubtful = self._doubted or self._unmeasured or self._settling or self.stale is not None
        if not self._known or not self._alive or doubtful:
            return WatchAhead(self, packets[:0])
        return WatchAhead(self, packets)

    def _contact(self) -> Contact:
        excess = np.where(np.isnan(self._excess), np.inf, self._excess)
        kind, joint = divmod(int(np.argmax(excess)), JOINTS)
        limit = float((self._most if kind == 0 else self.allowed)[joint])
        return Contact(_QUANTITIES[kind], joint, float(self._excess[kind, joint]) + limit, limit)


class WatchAhead:
    """Packets looked at beforehand, see `ContactWatch.ahead`; `place` takes them.

    count : of leading packets that need nothing else
    """

    def __init__(self, watch: ContactWatch, packets: Floats) -> None:
        self._watch = watch
        before = np.concatenate([watch._last[np.newaxis], packets[:-1]]) if len(packets) else packets
        change = packets - before
        self._packets, self._steps = packets, change[:, :JOINTS] + 0.0
        self.count = self._calm(before, change)
        if self.count:
            self._filter(before, change)
            self._estimate()
            self.count = self._within()

    def _calm(self, before: Floats, change: Floats) -> int:
        """Packets up to the first with a jump or a repeated position."""
        if not len(change):
            return 0
        watch = self._watch
        step = np.tile(watch._step, (len(change), 1))
        step[1:, :JOINTS] = self._steps[:-1]
        same = self._packets[:, :JOINTS] == before[:, :JOINTS]
        repeated = same & (np.abs(step[:, :JOINTS]) > watch._slowest)
        odd = np.abs(change - step)
        return min(leading(odd <= watch._jump), leading(~repeated))

    def _filter(self, before: Floats, change: Floats) -> None:
        """States of the low-pass after each packet, and its input: `ContactWatch._low_pass` for single cycles."""
        watch, ends = self._watch, 2 * JOINTS
        self._sources = change[: self.count, :ends] * 1.0
        self._sources += before[: self.count, :ends]
        self._sources += before[: self.count, :ends]
        self._states = np.empty((self.count, 2, ends))
        state, matrix = np.empty((3, ends)), watch._advance
        state[:2] = watch._state
        for source, result in zip(self._sources, self._states, strict=True):
            state[2] = source
            matrix.dot(state, result)
            state[:2] = result

    def _estimate(self) -> None:
        """The own estimate and its limit after each packet."""
        watch, states, packets = self._watch, self._states, self._packets[: self.count]
        q, qd, tau = states[:, 0, :JOINTS], states[:, 1, :JOINTS], states[:, 0, JOINTS:]
        qdd = watch._acceleration(q, qd, packets[:, :JOINTS])
        gravity = packets[:, 3 * JOINTS :]
        expected = np.empty_like(q)
        rnea, model, data = watch._pin.rnea, watch._model, watch._data
        for result, *rows in zip(expected, q, qd, qdd, strict=True):
            result[:] = rnea(model, data, *rows)
        if watch._listens and gravity.any():
            weight = np.array([watch._weight(row).copy() for row in q])
            given = np.any(gravity, axis=1, keepdims=True)
            expected = np.where(given, expected + gravity - weight, expected)
        self._open, self._allowed = (
            np.tile(watch._open, (self.count, 1)),
            np.tile(watch.allowed, (self.count, 1)),
        )
        if watch._friction:
            friction, unsure = watch._frictions(qd, qdd)
            expected = expected + friction
            open_now = watch._open
            for row, floor in enumerate(unsure):
                self._open[row] = open_now = np.maximum(floor, watch._closing * open_now)
            self._allowed = watch._threshold + watch._coulomb * self._open
        self._external = expected - tau

    def _within(self) -> int:
        """Packets up to the first with a limit exceeded."""
        torques = np.abs(self._packets[: self.count, JOINTS : 3 * JOINTS])
        good = (torques[:, :JOINTS] - self._watch._most <= 0.0) & (torques[:, JOINTS:] - self._allowed <= 0.0)
        good &= np.abs(self._external) - self._allowed <= 0.0
        return leading(good)

    def place(self, done: int) -> None:
        """Take the first `done` packets."""
        watch, last = self._watch, done - 1
        watch._last[:] = self._packets[last]
        watch._step[:JOINTS] = self._steps[last]
        watch._state[:], watch._input[:] = self._states[last], self._sources[last]
        watch._open = self._open[last].copy()
        watch.allowed[:], watch.external[:] = self._allowed[last], self._external[last]
        watch._bend[:] = 0.0
        watch._repeats = 0


def _parts(packet: Floats) -> tuple[Floats, ...]:
    """Views of a buffer: position, torque, the controller's estimate, gravity torque; torque and estimate as rows."""
    rows = packet.reshape(4, JOINTS)
    return rows[0], rows[1], rows[2], rows[3], rows[1:3]
