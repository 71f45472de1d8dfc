"""The identified model: parameter values with covariance and effects, and its file."""

from __future__ import annotations

from ident.model.covariance import nearest_covariance
from ident.model.dynamic_model import DynamicModel, Projection
from ident.model.model_file import Model, as_model, model_text, read_model, write_checked, write_model
from ident.model.signals import signal_settings, signals_entry

__all__ = [
    "DynamicModel",
    "Model",
    "Projection",
    "as_model",
    "model_text",
    "nearest_covariance",
    "read_model",
    "signal_settings",
    "signals_entry",
    "write_checked",
    "write_model",
]
