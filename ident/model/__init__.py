"""The identified model: parameter values with covariance and effects, and its file."""

from __future__ import annotations

from ident.model.dynamic_model import DynamicModel, Projection
from ident.model.model_file import Model, as_model, model_text, read_model, write_model

__all__ = [
    "DynamicModel",
    "Model",
    "Projection",
    "as_model",
    "model_text",
    "read_model",
    "write_model",
]
