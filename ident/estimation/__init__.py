"""Identification of a model from session logs, its validation, comparison and payloads."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fri.on_first_use import on_first_use

if TYPE_CHECKING:
    from ident.estimation.compare import Comparison, compare, competitor_scores
    from ident.estimation.essential import EssentialSettings
    from ident.estimation.forward_simulation import simulate_session
    from ident.estimation.identification import EstimatorFactory, Identification, IdentificationSettings
    from ident.estimation.identify import ESTIMATORS, identify, known_settings
    from ident.estimation.mounting import Mounting, find_mounting
    from ident.estimation.payload import PayloadEstimate, identify_payload, with_payload
    from ident.estimation.scores import Score, SessionScore, score_session, torque_error
    from ident.estimation.validate import (
        CrossValidation,
        Unscored,
        Validation,
        cross_validate,
        mounted,
        predictor,
        prepared_session,
        signals_for,
        validate,
    )

__all__ = [
    "ESTIMATORS",
    "Comparison",
    "CrossValidation",
    "EssentialSettings",
    "EstimatorFactory",
    "Identification",
    "IdentificationSettings",
    "Mounting",
    "PayloadEstimate",
    "Score",
    "SessionScore",
    "Unscored",
    "Validation",
    "compare",
    "competitor_scores",
    "cross_validate",
    "find_mounting",
    "identify",
    "identify_payload",
    "known_settings",
    "mounted",
    "predictor",
    "prepared_session",
    "score_session",
    "signals_for",
    "simulate_session",
    "torque_error",
    "validate",
    "with_payload",
]

_HOMES = {
    ".compare": (
        "Comparison",
        "compare",
        "competitor_scores",
    ),
    ".essential": ("EssentialSettings",),
    ".forward_simulation": ("simulate_session",),
    ".identify": (
        "ESTIMATORS",
        "EstimatorFactory",
        "Identification",
        "IdentificationSettings",
        "identify",
        "known_settings",
    ),
    ".mounting": (
        "Mounting",
        "find_mounting",
    ),
    ".payload": (
        "PayloadEstimate",
        "identify_payload",
        "with_payload",
    ),
    ".scores": (
        "Score",
        "SessionScore",
        "score_session",
        "torque_error",
    ),
    ".validate": (
        "CrossValidation",
        "Unscored",
        "Validation",
        "cross_validate",
        "mounted",
        "predictor",
        "prepared_session",
        "signals_for",
        "validate",
    ),
}

__getattr__, __dir__ = on_first_use(globals(), _HOMES)
