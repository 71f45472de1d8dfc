"""Single samples far from their neighbours, left out of the rows: misread or misprinted values."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import Floats, joint_unit
from ident.rows.content import Recall
from ident.rows.filters import SignalSettings
from ident.rows.prepare import outliers
from ident.rows.timebase import BoolArray
from ident.screening.doubts import Doubt, torques_of
from lwr_driver.session import JointColumns, Session
from lwr_driver.session.spool import column

_AROUND = 2


def spikes(values: Floats, recall: Recall | None = None) -> BoolArray:
    """Flags (n, k) of samples of positions or torques that no row uses, with the settings of every day. recall : as for
    `prepare`."""
    return outliers(values, SignalSettings().outlier_scale, recall or Recall())[0]


def check_spikes(session: Session, chain: Chain, recall: Recall | None = None) -> Iterator[Doubt]:
    """Spikes of the positions, and those of the torques beyond all other torques of the recording."""
    joint, name = session.joint, session.path.name
    lengths, units = chain.prismatic.tolist(), list(chain.torque_units)
    yield from position_spikes(_seconds(joint), joint.position, session.joint_names, lengths, name, recall)
    for channel, columns in torques_of(session):
        yield from torque_spikes(
            _seconds(columns), columns.effort, columns.names, units, channel, name, recall
        )


def position_spikes(
    times: Floats,
    values: Floats,
    names: Sequence[str],
    prismatic: Sequence[bool],
    session: str = "",
    recall: Recall | None = None,
) -> Iterator[Doubt]:
    """Doubts about positions (n, k) [rad or m] at times (n,) [s]."""
    units = [joint_unit("rad", prismatic=slides) for slides in prismatic]
    yield from _doubts(times, values, names, units, "position", session, 0.0, recall)


def torque_spikes(
    times: Floats,
    values: Floats,
    names: Sequence[str],
    units: Sequence[str],
    channel: str,
    session: str = "",
    recall: Recall | None = None,
) -> Iterator[Doubt]:
    """Doubts about torques (n, k) at times (n,) [s]; shocks of a motion may be spikes, but not beyond all others."""
    yield from _doubts(times, values, names, units, channel, session, 1.0, recall)


def _doubts(
    times: Floats,
    values: Floats,
    names: Sequence[str],
    units: Sequence[str],
    channel: str,
    session: str,
    least: float,
    recall: Recall | None,
) -> Iterator[Doubt]:
    """least : size of a spike over the range of the other samples."""
    flags = spikes(values, recall)
    for k in map(int, np.flatnonzero(flags.any(axis=0))):
        own, places = column(values, k), np.flatnonzero(flags[:, k])
        sizes = np.array([_size(own, int(place)) for place in places])
        beyond = sizes > least * float(np.ptp(own[~flags[:, k]]))
        places, sizes = places[beyond], sizes[beyond]
        if not len(places):
            continue
        worst = int(np.argmax(sizes))
        one = len(places) == 1
        size = f"{'' if one else 'up to '}{sizes[worst]:.3g} {units[k]}"
        at = f"at {times[places[worst]]:.4g} s (sample {places[worst]})"
        seen = f"{channel} off by {size} in {len(places)} of {len(own)} samples, {at}"
        looks = "a misread value" if one else "misread values"
        mend = f"{'it is' if one else 'they are'} left out of the rows; correct the recording"
        # A channel of its own: the rest of the column is sound.
        yield Doubt("spike", (names[k],), seen, looks, mend, False, session)


def _size(values: Floats, place: int) -> float:
    """Distance of a sample from the median of its neighbours."""
    first = max(place - _AROUND, 0)
    around = np.delete(values[first : place + _AROUND + 1], place - first)
    return float(abs(values[place] - np.median(around)))


def _seconds(columns: JointColumns) -> Floats:
    return np.asarray((columns.log_time - columns.log_time[:1]) * 1e-9, dtype=np.float64)
