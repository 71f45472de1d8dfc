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
from ident.effects import ELASTICITY, parameter_values
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


def taken_back(model: DynamicModel) -> tuple[Mapping[str, Any], ...]:
    """Effects of a model whose twist is taken back with the links, see `softened`: joints softer than the signal
    settings say, behind encoders at the motors."""
    form = ELASTICITY.at_encoder("motor").form
    assert form is not None
    return tuple(
        one for one in model.effects if one["cause"] == ELASTICITY.cause and one.get("form") == form.value
    )


def softened(settings: SignalSettings, model: DynamicModel) -> SignalSettings:
    """Settings that take the links back by the twist that the model's effects add, too: from the measured torque, in
    which the links ring."""
    if settings.stiffness_nm_rad is None or not settings.takes_links_back:
        return settings
    compliance = 1.0 / np.array(settings.stiffness_nm_rad)
    for entry in taken_back(model):
        compliance[[joint - 1 for joint in entry["joints"]]] += parameter_values(entry)["compliance"]
    return dataclasses.replace(settings, stiffness_nm_rad=tuple((1.0 / compliance).tolist()))


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
