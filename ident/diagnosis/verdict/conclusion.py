"""From claims to the diagnosis: findings, remainders, the extended model, the notes."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fri.errors import DataError
from ident.diagnosis.causes.claims import Claim
from ident.diagnosis.causes.probes import Remainder, find_remainders
from ident.diagnosis.causes.tolerances import HABITUAL, Deviation, Kind
from ident.diagnosis.gain.held_out import BEYOND_HEALTHY, HeldOut, held_out, worse_rows
from ident.diagnosis.gain.products import Floats, Rows
from ident.diagnosis.healthy.bench import DiagnosisBench
from ident.diagnosis.outcome.result import (
    Diagnosis,
    Finding,
    Nameless,
    RowStates,
    SimulationError,
    Unexplained,
)
from ident.diagnosis.outcome.torque_errors import TorqueErrors, errors_of_both
from ident.diagnosis.rows.nominal import Nominal
from ident.diagnosis.rows.recording import TRAVEL_RAD
from ident.diagnosis.verdict.confidence import believable
from ident.diagnosis.verdict.confirmation import FELT_POWER, Confirmed, confirmed, contradicted, doubted
from ident.diagnosis.verdict.extension import Member, extension, power_left, title, titles
from ident.diagnosis.verdict.findings import in_order, limit_findings, loss_finding, sizeless
from ident.diagnosis.verdict.models import changes_of, fitted_models, staying, without_harm
from ident.diagnosis.verdict.payloads import unchecked_masses
from ident.diagnosis.verdict.refit import BY_IDENTIFY, Entries, left_by, refitted
from ident.diagnosis.verdict.task import Baseline, State, Task
from ident.diagnosis.verdict.wear import Worn, is_level, wear
from ident.effects import EFFECTS
from ident.model import DynamicModel
from ident.rows.data_quality import sample_loss

log = logging.getLogger(__name__)

# Change of a healthy sensor in one of a hundred days, in standard deviations.
_UNUSUAL = 2.6


def conclude(task: Task, state: State) -> Diagnosis:
    """The diagnosis from the claims of a selection, the timing findings and the lost samples."""
    bench, nuisance = state.bench, state.selection.nuisance_rows
    evidence, nominal, healthy = bench.evidence, bench.nominal, task.reference
    baseline = state.baseline if state.timing else None
    baseline = baseline or Baseline.of(bench, nuisance, staying(state.selection))
    borne_out, refuted = confirmed(task, state)
    claimed = _believed(task, state, borne_out)
    worn = _worn(task, state, claimed)
    members, after = extension(bench, baseline, _members(nominal, claimed), nuisance, task.settings.seed)
    told = _told_models(task, state, baseline, members, after)
    findings, doubts = _findings(task, state, told, claimed, [*state.loads, *worn.findings], refuted)
    rms_base, rms_extended = told.before.rms(), told.after.rms()
    left = _left(task, evidence.floor, told, findings, claimed.remainders)
    simulation, extended_simulation = _simulated(task, told)
    return Diagnosis(
        train=tuple(r.name for r in nominal.recordings if not r.test),
        test=tuple(r.name for r in nominal.recordings if r.test),
        model_number=nominal.structure.model,
        findings=tuple(f for f in findings if not _is_character(task, f)),
        character=tuple(f for f in findings if _is_character(task, f)),
        referenced=healthy is not None,
        numbered=tuple(r.name for r in nominal.recordings),
        healthy=() if healthy is None else tuple(healthy.model.effects),
        healthy_left={} if healthy is None else healthy.left,
        doubted=tuple(doubts),
        nameless=told.nameless,
        extension=told.added,
        unexplained=(
            *(
                Unexplained(side, j, variables, *_error_and_noise(rms_extended, evidence.floor, side, j))
                for side, j, variables in _stuck(nominal)
            ),
            *left,
        ),
        noise_floor=evidence.floor,
        rms_base=rms_base,
        rms_extended=rms_extended,
        base_model=told.base,
        extended_model=told.extended,
        changes=changes_of(told.base, told.extended) if told.added else {},
        scores=state.selection.scores,
        nuisance=state.selection.nuisance,
        simulation_base=simulation,
        simulation_extended=extended_simulation,
        notes=(
            *_notes(task, bench, rms_base),
            *_channel_notes(nominal, claimed.remainders),
            *tolerated_gains(state.selection.deviations, nominal.arm.chain.joint_names),
            *state.notes,
            *told.notes,
            *worn.notes(),
        ),
        residuals={"base": told.before.residual, "extended": told.after.residual},
        states={side: _states(nominal, side, told.before.block[side]) for side in nominal.rows},
        torque_base=None if told.errors is None else told.errors[0],
        torque_extended=None if told.errors is None else told.errors[1],
        torque_present=_of_present(task),
    )


class _Claimed(NamedTuple):
    """Claims that are believed, the finding of each, findings hardly believed, and the remainders beside the claims."""

    claims: Sequence[Claim]
    findings: Sequence[Finding]
    doubts: Sequence[Finding]
    remainders: tuple[Remainder, ...]

    @property
    def rows(self) -> list[Rows]:
        """Columns of the claims."""
        return [claim.trial.rows for claim in self.claims]


def _believed(task: Task, state: State, borne_out: Sequence[Confirmed]) -> _Claimed:
    """The claims that held-out rows bear out, told by the remainders beside them; they stay in the evidence."""

    def remainders(some: Sequence[Confirmed]) -> tuple[Remainder, ...]:
        evidence = state.bench.evidence
        evidence.replace([*(one.claim.trial.rows for one in some), *state.selection.nuisance_rows])
        return find_remainders(state.bench.dictionary, task.settings, task.limits)

    kept = [one for one in borne_out if not is_level(one.claim)]
    left = remainders(kept)
    findings = doubted(task, state, kept, left)
    compared = task.reference is not None
    believed = [believable(f.grounds) and not (compared and sizeless(f)) for f in findings]
    doubts = [f for f, is_one in zip(findings, believed, strict=True) if not is_one]
    if doubts:
        # A name hardly believed is no finding; what it explained is left to the remainders.
        kept = [one for one, is_one in zip(kept, believed, strict=True) if is_one]
        findings = [f for f, is_one in zip(findings, believed, strict=True) if is_one]
        left = remainders(kept)
    return _Claimed([one.claim for one in kept], findings, doubts, left)


def _worn(task: Task, state: State, claimed: _Claimed) -> Worn:
    """Changed drives; none without a healthy arm."""
    if task.reference is None:
        return Worn()
    bench, selection = state.bench, state.selection
    shown = held_out(bench.evidence, [*claimed.rows, *selection.nuisance_rows])
    # Without the reference's prior, gains of the sensors and drive inertias compensate each other, and so do
    # Coulomb and viscous friction and further laws, of fixed size or none in the reference's parameters.
    free = (Kind.GAIN, Kind.SIZE, Kind.HABIT)
    tolerated = [one.tolerance.rows for one in selection.deviations if one.tolerance.kind not in free]
    return wear(bench, task.reference, shown, claimed.rows, tolerated, claimed.remainders)


def _members(nominal: Nominal, claimed: _Claimed) -> list[Member]:
    """What may be in the extended model: the claims with a value in a further session, and terms without a name."""
    named = [
        Member((claim.trial.rows,), claim.gain, finding=finding)
        for claim, finding in zip(claimed.claims, claimed.findings, strict=True)
        # A change between sessions has no value in a further one, and an event cannot be predicted.
        if not claim.trial.passing and (nominal.held_out or not claim.trial.candidate.effect.event)
    ]
    nameless = [
        Member(tuple(dict.fromkeys([(r.side, r.joint - 1)], t.column) for t in r.terms), r.gain, remainder=r)
        for r in claimed.remainders
        if r.terms
    ]
    return [*named, *nameless]


def _is_character(task: Task, finding: Finding) -> bool:
    return task.reference is None and EFFECTS[finding.cause].character


def _findings(
    task: Task,
    state: State,
    told: _Told,
    claimed: _Claimed,
    of_parameters: Sequence[Finding],
    refuted: Sequence[Finding],
) -> tuple[list[Finding], list[Finding]]:
    """All findings in their order, and the doubted ones.

    of_parameters : of payloads and wear. refuted : by held-out rows.
    """
    evidence, nominal = state.bench.evidence, state.bench.nominal
    named = [*claimed.findings, *state.timing]
    named = [contradicted(f) if any(f is r for r in told.refuted) else f for f in named]
    # What every such drive has stays character where none of the extension is in the model.
    is_told = [believable(f.grounds) or (told.rejected and _is_character(task, f)) for f in named]
    found = [f for f, is_one in zip(named, is_told, strict=True) if is_one]
    found += of_parameters
    usual = {} if task.reference is None else task.reference.lost
    losses = [one for one in sample_loss(task.sessions) if one.beyond(usual.get(one.channel, 0.0))]
    if losses:
        found.append(loss_finding(losses[0]))
    found += limit_findings(nominal.recordings, found)
    doubts = [*claimed.doubts, *(f for f, is_one in zip(named, is_told, strict=True) if not is_one)]
    doubts += [*state.hardly, *refuted]
    places = {(f.cause, f.joints) for f in found}
    doubts = [d for d in doubts if (d.cause, d.joints) not in places]
    return in_order(sorted(found, key=lambda f: -f.gain), evidence.floor), doubts


def _left(
    task: Task,
    floor: Mapping[str, Floats],
    told: _Told,
    findings: Sequence[Finding],
    remainders: Sequence[Remainder],
) -> list[Unexplained]:
    """What neither a finding nor a term of the model explains. floor : noise (n,) [Nm] by side."""
    fitted = {(term.side, term.joint) for term in told.nameless}
    rms = told.after.rms()
    left = []
    for r in remainders:
        one = Unexplained(r.side, r.joint, r.depends_on, *_error_and_noise(rms, floor, r.side, r.joint))
        felt = (r.side, r.joint) not in fitted and r.inflation > FELT_POWER
        # A line stands out of the spectrum below the noise of a row.
        if felt and (one.beyond_noise or r.line_hz):
            left.append(one)
    return [*left, *_beyond_healthy(task, told.before.rms(), rms, findings, told.added, left)]


def _simulated(task: Task, told: _Told) -> tuple[SimulationError | None, SimulationError | None]:
    """Errors of the simulations with the present model, else the base one, and with the extended one."""
    if task.simulate is None:
        return None, None
    replayed = list(task.test) or list(task.sessions)
    present = task.simulate(task.model or told.base, replayed)
    changed = told.extended.effects != told.base.effects
    return present, task.simulate(told.extended, replayed) if changed else present


def _of_present(task: Task) -> TorqueErrors | None:
    """Errors of the present model in the test sessions; None without either, or for another arm's model."""
    if task.model is None or not task.test:
        return None
    try:
        return TorqueErrors.of(task.model, task.test)
    except DataError as error:
        log.info("no error of the present model: %s", error)
        return None


class _Told(NamedTuple):
    """The models of the diagnosis. added : what the extended one has more. before, after : held-out rows without and
    with the extension. refuted : findings with an effect that raises the torque error of the test sessions. rejected :
    whether all of the extension went. errors : of base and extended model in the test sessions, None without any."""

    base: DynamicModel
    extended: DynamicModel
    added: tuple[str, ...]
    nameless: tuple[Nameless, ...]
    before: HeldOut
    after: HeldOut
    refuted: tuple[Finding, ...]
    rejected: bool
    errors: tuple[TorqueErrors, TorqueErrors] | None
    notes: tuple[str, ...] = ()


def _told_models(
    task: Task, state: State, baseline: Baseline, members: list[Member], after: HeldOut
) -> _Told:
    """Base and extended model, by the evidence or by `identify`, and what they leave in the held-out data.

    members : of the extension. after : held-out rows with them.
    """
    by_identify = task.sound and state.bench.evidence.drawn
    refuted, errors = tuple[Finding, ...](), None
    if task.test and not by_identify:
        after, made, refuted, errors = without_harm(task, state, baseline, members, after)
    else:
        made = fitted_models(task, state, baseline, members, after)
    before, after = baseline.held.where(after), after.where(baseline.held)
    told = _Told(
        made.base, made.extended, titles(made.added), made.nameless, before, after, refuted, False, errors
    )
    if by_identify:
        try:
            told = _by_identify(task, state, members, made.added, told)
        except DataError as error:
            told = told._replace(
                notes=(f"the models are those of the evidence, for `identify` says: {error}",)
            )
    if task.test and told.errors is None:
        told = told._replace(errors=errors_of_both(told.base, told.extended, task.test))
    return told


def _by_identify(task: Task, state: State, members: Sequence[Member], added: Entries, told: _Told) -> _Told:
    """The models by `identify` in place of those by the evidence, `told`. added : effects of the extension.

    Raises DataError for sessions that `identify` refuses.
    """
    nominal = state.bench.nominal
    base, ways = refitted(task, nominal, added)
    extended, before, after, errors, harmful = _shipped(
        task, nominal, base, ways, members, (told.before, told.after)
    )
    own = titles(base.effects)
    more = [entry for entry in extended.effects if title(entry) not in own]
    if errors is None or not harmful:
        return told._replace(
            base=base, extended=extended, added=titles(more), before=before, after=after, errors=errors
        )
    gone = {(entry["cause"], tuple(entry["joints"])) for entry in more}
    named = [*(m.finding for m in members if m.finding is not None), *state.timing]
    refuted = tuple(f for f in named if (f.cause, f.joints) in gone)
    return _Told(base, base, (), (), before, before, refuted, True, (errors[0], errors[0]))


def _shipped(
    task: Task,
    nominal: Nominal,
    base: DynamicModel,
    ways: Iterator[DynamicModel],
    members: Sequence[Member],
    held: tuple[HeldOut, HeldOut],
) -> tuple[DynamicModel, HeldOut, HeldOut, tuple[TorqueErrors, TorqueErrors] | None, bool]:
    """The first way to the extended model without harm in the held-out rows and sessions, else the last one; the rows
    with the base model and with it, the errors of both in the sessions, and whether it does harm.

    Harm is no gain over all rows or all samples, or a worse row, see `worse_rows`. held : rows by the evidence.
    """
    before, after = held
    if not nominal.held_out:
        return next(ways), before, after, None, False
    own = [m for m in members if m.finding is None or m.finding.cause not in BY_IDENTIFY]
    acting = {key for member in own for rows in member.rows for key in rows}
    before, of_base = left_by(base, nominal, before), TorqueErrors.of(base, task.test)
    for extended in ways:
        left = left_by(extended, nominal, after)
        errors = of_base, of_base if extended is base else TorqueErrors.of(extended, task.test)
        harmful = (
            power_left(before, left) >= 1.0
            or errors[1].left_of(of_base) > 1.0
            or bool(worse_rows(before, left, task.settings.seed, acting))
        )
        if not harmful:
            break
    return extended, before, left, errors, harmful


def _states(nominal: Nominal, side: str, block: NDArray[np.int64]) -> RowStates:
    rows, motions = nominal.rows[side], nominal.motions
    signals = ([m.q for m in motions], [m.motor_speed for m in motions], [m.joint_torque for m in motions])
    return RowStates(rows.time, rows.session, block, *(nominal.grid.reduce(side, parts) for parts in signals))


# ---- notes ----


def _stuck(nominal: Nominal) -> list[tuple[str, int, tuple[str, ...]]]:
    """Side, joint (from 1) and variable of motor torques with stuck values."""
    joints = {one.joint for r in nominal.recordings if not r.test for one in r.stuck}
    return [("motor", joint + 1, (f"load{joint + 1}",)) for joint in sorted(joints)]


def _beyond_healthy(
    task: Task,
    before: Mapping[str, Floats],
    after: Mapping[str, Floats],
    findings: Sequence[Finding],
    added: Sequence[str],
    known: Sequence[Unexplained],
) -> list[Unexplained]:
    """Torques with an error far beyond that of the healthy days, of no known variable. Their noise floor is what these
    may leave, with room for other motions: without a repeated motion any error may pass for noise.

    before, after : errors of base and extended model. Less than the extension takes off an error is that of its laws. A
    finding that the extension, `added`, does not hold explains the error of its joints. known : remainders of the same
    kind.
    """
    healthy = {} if task.reference is None else task.reference.left
    open_ = [f.joints for f in findings if title({"cause": f.cause, "joints": f.joints}) not in added]
    if () in open_:
        return []
    explained = {joint for joints in open_ for joint in joints}
    told = {(one.side, one.joint) for one in known}
    found: list[Unexplained] = []
    for side, usual in healthy.items():
        if side not in after:
            continue
        limit = BEYOND_HEALTHY * usual
        far = after[side] > limit
        far &= after[side] ** 2 - usual**2 > before[side] ** 2 - after[side] ** 2
        joints = (np.flatnonzero(far) + 1).tolist()
        found += [
            Unexplained(side, j, (), float(after[side][j - 1]), float(limit[j - 1]))
            for j in joints
            if j not in explained and (side, j) not in told
        ]
    return found


def _error_and_noise(
    rms: Mapping[str, Floats], floor: Mapping[str, Floats], side: str, joint: int
) -> tuple[float, float]:
    """Error on held-out rows and noise floor [Nm] of a joint (from 1)."""
    return float(rms[side][joint - 1]), float(floor[side][joint - 1])


def _channel_notes(nominal: Nominal, remainders: Sequence[Remainder]) -> list[str]:
    names = nominal.arm.chain.joint_names
    lines = [
        f"the {r.side} torque of {names[r.joint - 1]} swings at {_frequency(nominal, r.line_hz)} independently of the "
        "motion; look for a vibration of the arm or hum in the channel at this frequency"
        for r in remainders
        if r.line_hz > 0.0
    ]
    stuck = [
        f"{r.name}: the motor torque of {names[one.joint]} reads exactly {one.value:.4g} Nm in {one.count} of "
        f"{one.samples} samples in motion; torques near this value are misreported, and these samples are left out"
        for r in nominal.recordings
        for one in r.stuck
    ]
    return lines + stuck


def tolerated_gains(deviations: Sequence[Deviation], names: Sequence[str]) -> list[str]:
    """Gains of torque sensors that are hardly usual and still tolerated, as few healthy sets tell little of the days.

    deviations : in the fit of the claims. names : of the joints.
    """
    lines = []
    for one in deviations:
        day = one.tolerance.size / HABITUAL
        if one.tolerance.kind is Kind.GAIN and abs(one.value) > _UNUSUAL * max(day, one.std):
            lines.append(
                f"the torque sensor of {names[one.tolerance.number]} reads {100.0 * abs(one.value):.2g} ± "
                f"{100.0 * one.std:.1g} % too {'much' if one.value > 0.0 else 'little'} against the healthy days, "
                f"whose sets leave {100.0 * day:.2g} % from day to day open: no finding, and in no model; more healthy "
                "sets decide"
            )
    return lines


def _frequency(nominal: Nominal, line_hz: float) -> str:
    """A frequency in rows; in those of longer means than usual one beyond their band looks like it."""
    mean_s = nominal.bin_s
    if mean_s <= nominal.settings.bin_s:
        return f"{line_hz:.3g} Hz"
    return f"{line_hz:.3g} or {1.0 / mean_s - line_hz:.3g} Hz, not told apart in means over {1e3 * mean_s:.0f} ms,"


def _notes(task: Task, bench: DiagnosisBench, measured: Mapping[str, Floats]) -> list[str]:
    """Limits of the data. measured : rms (n,) [Nm] of the held-out rows by side."""
    notes, nominal, evidence, reference = [], bench.nominal, bench.evidence, task.reference
    if "motor" not in nominal.rows:
        notes.append(
            "no motor torque: causes on the motor side are invisible, and a sensor error differs from a torque of "
            "the arm by its shape alone"
        )
    if "joint" not in nominal.rows:
        notes.append(
            "no joint torque: errors of its sensors are invisible, and torques on the links are separated from those "
            "in the drives by their shape alone"
        )
    for side, rms in measured.items():
        if np.isnan(rms).all():
            held = bool(nominal.rows[side].valid.any())
            notes.append(
                f"no row of the {side} torque is usable{' in the held-out data' if held else ''}: its errors are "
                f"unknown{' there' if held else ', and causes that it alone shows are invisible'}"
            )
    if len(task.everything) == 1:
        notes.append(
            "one session: changes from session to session (warm-up, a drifting zero, a payload) are invisible, and "
            "errors are measured on parts of the one motion"
        )
    if reference is None:
        notes.append(
            "no reference of the healthy arm: a constant change absorbed by base parameters (payload, torque "
            "constant, wear, offsets) is invisible, and what such drives have when healthy is told as character of the "
            "arm, not as a finding; run `lwr-run commission` with the healthy arm"
        )
    elif evidence.prior is None:
        notes.append(
            "the reference shares no base parameter with these sessions: parameters are not compared"
        )
    if reference is not None:
        notes += [
            f"payload {name!r}: its stated mass was not checked, for sessions with one payload alone do not tell it "
            "from the last link, and the reference was learned without it; add a session without a payload"
            for name in unchecked_masses(nominal.base, nominal.masses, reference)
        ]
    for side, band in nominal.grid.band_hz.items():
        if band is not None:
            notes.append(
                f"the {side} torque was low-passed before recording, with nothing left above {2.0 * band:.2g} Hz: "
                f"rows are compared below {band:.2g} Hz; delays, reversals and ripple per motor turn are invisible"
            )
    still = np.flatnonzero(~nominal.moving)
    if len(still):
        names = ", ".join(nominal.arm.chain.joint_names[j] for j in still)
        notes.append(f"{names}: no motion of {TRAVEL_RAD} rad or more, so no diagnosis there")
    if not bench.repeatable and not evidence.compared:
        notes.append(
            "no motion repeats within a session: the residual of the model is the only measure of noise, so only "
            "causes of a large part of it are named"
        )
    if task.settings.signals.takes_links_back:
        notes.append(
            "the positions are taken for those of the motors, by what they predict or as stated; the links stand "
            f"behind them by up to {1e3 * _largest_twist(nominal):.2g} mrad, and a claim of elasticity adds to that"
        )
    if evidence.drawn:
        notes.append(
            "hardly excited parameters are held near the inertia of the URDF, within 20 %: a wrong URDF would show "
            "as a cause"
        )
    return notes


def _largest_twist(nominal: Nominal) -> float:
    """Largest twist of a joint [rad]."""
    return max(float(np.max(np.abs(m.joint_torque) * nominal.arm.compliance)) for m in nominal.motions)
