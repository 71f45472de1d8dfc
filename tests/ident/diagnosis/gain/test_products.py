"""Products of columns, and the scale of what has none."""

from __future__ import annotations

import numpy as np

from ident.diagnosis.gain.products import inverse_of, scale_of


def test_a_column_of_rounding_errors_has_no_scale() -> None:
    """Scaled to one it would decide everything."""
    columns = np.random.default_rng(1).normal(size=(50, 3)) * [10.0, 1e-6, 1e-17]
    gram = columns.T @ columns
    scale = scale_of(np.diag(gram))
    assert np.all(scale[:2] > 0.0)
    assert scale[2] == 0.0
    values = inverse_of(gram + np.diag([0.0, 0.0, 1e-6]), scale) @ columns.T @ (columns @ [2.0, 3.0, 0.0])
    assert np.allclose(values, [2.0, 3.0, 0.0], rtol=1e-3)
    assert np.array_equal(scale_of(np.zeros(2)), np.zeros(2))
