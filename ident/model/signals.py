"""The signal settings of a model: how the motion and torque of its estimate were filtered and put in time.

They stand in the provenance of the model, so that `validate`, `diagnose` and the report filter a further session
in the same way::

    provenance:
      signals: {cutoff_hz: 10.0, decimate_hz: 2.0, ..., motor_delay_s: 0.0012, joint_delay_s: 0.0}
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fri.errors import ConfigurationError
from ident.model.dynamic_model import DynamicModel
from ident.rows.delay import shared_delay
from ident.rows.filters import SignalSettings
from ident.rows.prepared import PreparedSession

SIGNALS = "signals"


def signals_entry(settings: SignalSettings, prepared: Sequence[PreparedSession] = ()) -> dict[str, Any]:
    """The entry of a model's provenance.

    prepared : sessions of the estimate. Their cut-off and the delays of the torques of those that agree replace a
    choice or an estimate in the settings.
    """
    entry = dataclasses.asdict(settings)
    if prepared:
        entry["cutoff_hz"] = float(np.median([one.cutoff_hz for one in prepared]))
    for name in dict.fromkeys(name for one in prepared for name in one.delays):
        entry[name], _ = shared_delay([one.delays[name] for one in prepared if name in one.delays])
    return entry


def positions_of_motors(model: DynamicModel) -> bool:
    """Whether a model takes the positions for those of the motors."""
    settings = signal_settings(model)
    return settings is not None and settings.takes_links_back


def signal_settings(model: DynamicModel) -> SignalSettings | None:
    """The signal settings of a model, its delays included; None for a model without.

    Keys of other versions of this software are left aside. Raises ConfigurationError for values out of range.
    """
    entry = model.provenance.get(SIGNALS)
    if not isinstance(entry, Mapping):
        return None
    known = {field.name for field in dataclasses.fields(SignalSettings)}
    try:
        return SignalSettings(**{str(key): value for key, value in entry.items() if key in known})
    except (ConfigurationError, TypeError) as error:
        raise ConfigurationError(
            f"the model of {model.robot}: `provenance.signals` cannot be used: {error}; correct it, or give "
            "--settings"
        ) from error
