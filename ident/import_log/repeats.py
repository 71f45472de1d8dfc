"""Rows that repeat the one before: counted, and left out where the recorder polls faster than the arm measures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ident.import_log.channels import ONCE, Channel
from lwr_driver.session.spool import spans

# Least number of measurements for an even repetition, and least mean number of rows of each.
_LEAST_POLLED, _LEAST_POLLS = 50, 1.2


def repeated(channels: Mapping[str, Channel]) -> int:
    """Samples equal to the one before in every value of `/joint_states`."""
    once = [channels[name].values for name in ONCE if name in channels]
    alike = np.ones(len(once[0]) - 1, dtype=bool)
    for values in once:
        for some in spans(len(alike)):
            block = values[some.start : some.stop + 1]
            alike[some] &= (block[1:] == block[:-1]).all(axis=1)
    return int(np.count_nonzero(alike))


def once_each(channels: dict[str, Channel]) -> tuple[dict[str, Channel], list[str]]:
    """The channels without the rows of a recorder that evenly polls faster than the arm measures, and a note on it.

    Rows repeat in every value of all channels, each once or several times and no more than the next whole number: an
    arm at rest, or a recorder that falls behind, has longer runs, and keeps all rows.
    """
    joint = channels["position"]
    alike = np.ones(len(joint.times) - 1, dtype=bool)
    for one in channels.values():
        if not np.array_equal(one.times, joint.times):
            return channels, []
        alike &= (one.values[1:] == one.values[:-1]).all(axis=1)
    first = np.flatnonzero(np.append(True, ~alike))
    lengths = np.diff(first)
    if (
        len(lengths) < _LEAST_POLLED
        or lengths.mean() < _LEAST_POLLS
        or lengths.max() > np.ceil(lengths.mean())
    ):
        return channels, []
    rate = 1e9 / np.diff(joint.times).mean()
    note = (
        f"{len(joint.times) - len(first)} of {len(joint.times)} rows repeat the one before evenly: recorded at "
        f"{rate:.3g} Hz from an arm that measures at {rate / lengths.mean():.3g} Hz; one row of each is taken"
    )
    once = {
        name: replace(one, times=one.times[first], published=one.published[first], values=one.values[first])
        for name, one in channels.items()
    }
    return once, [note]
