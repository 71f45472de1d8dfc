"""Names of the estimators and a line on each, for help pages: this module imports nothing."""

from __future__ import annotations

AUTO = "auto"
"""In place of the name of an estimator: the one that predicts best, see `ident.estimation.estimator_comparison`."""

SUMMARIES = {
    "ols": "ordinary least squares, for comparison",
    "wls": "least squares weighted by joint and side",
    "huber": "robust: linear loss for large residuals",
    "tukey": "robust: constant loss for large residuals",
    "tls": "total least squares: noise in the regressor too",
    "recursive": "recursive, for parameters that drift",
    "mixing": "one scalar regression per parameter, for weak excitation",
    "map": "least squares with the URDF's inertials as prior",
    "physical": "`map` over physically consistent bodies, for prediction",
    "iv": "instrumental variables from the commanded motion",
}
"""The estimators that can be chosen by name, each in a line."""
