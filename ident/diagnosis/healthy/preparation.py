"""From the sessions of a diagnosis to records: the signals' settings, and channels that are broken."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from ident.diagnosis.healthy.reference import Reference
from ident.diagnosis.rows.broken_data import BrokenChannel, blamed, screened, without_broken
from ident.diagnosis.rows.recording import SessionRecord, record, settled, some_joint_moves
from ident.diagnosis.settings import DiagnosisSettings
from ident.dynamics.kinematics import Chain
from ident.dynamics.structure import Coupling
from ident.model.signals import signal_settings
from ident.rows.content import Recall
from ident.screening.doubts import Doubt
from lwr_driver.session import Session


@dataclass(frozen=True, eq=False)
class Preparation:
    """Records of all sessions in the order of their beginnings, without the channels that are broken, and the settings
    with the signals that they were filtered with. doubts : not certain, of channels that stay."""

    settings: DiagnosisSettings
    recordings: tuple[SessionRecord, ...]
    broken: tuple[BrokenChannel, ...]
    doubts: tuple[Doubt, ...] = ()


def preparation(
    sessions: Sequence[Session],
    test: Sequence[Session],
    chain: Chain,
    settings: DiagnosisSettings,
    couplings: Sequence[Coupling] = (),
    reference: Reference | None = None,
    broken: Sequence[BrokenChannel] | None = None,
) -> Preparation:
    """Filters sessions as the reference's were, else as `identify` would.

    broken : channels known to be, by the place of their session; None looks for them. Raises DataError for unusable
    sessions.
    """
    everything, held = sorted([*sessions, *test], key=lambda s: s.start), {id(s) for s in test}
    recall, doubts = Recall(), tuple[Doubt, ...]()
    if broken is None:
        # As `identify` does, whatever a reference filters with.
        broken, doubts = screened(everything, chain, settings.signals, couplings, recall=recall)
    known = None if reference is None else signal_settings(reference.model)
    if known is not None:
        # Of the reference's sessions, not of these.
        known = replace(known, motor_delay_s="estimate", joint_delay_s="estimate")
        settings = replace(settings, signals=known)
    with blamed(broken, chain.joint_names):
        healthy = reference is not None and reference.sets > 0
        settings = settled(settings, sessions, chain, couplings, healthy=healthy, recall=recall)
        recordings = tuple(
            record(s, k, chain, settings, test=id(s) in held, recall=recall) for k, s in enumerate(everything)
        )
        some_joint_moves(recordings)
        return Preparation(settings, without_broken(recordings, broken), tuple(broken), doubts)
