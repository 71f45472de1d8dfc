"""The same bytes from every process: no sum depends on the seed of the hashes of strings."""

from __future__ import annotations

import os
import subprocess
import sys

_SCRIPT = """
import numpy as np
from types import SimpleNamespace
from ident.diagnosis.gain.block_products import BlockProducts

random = np.random.default_rng(1)
keys = [(side, joint) for side in ("motor", "joint") for joint in range(7)]
columns = {key: random.normal(size=(60, 2)) for key in keys}
weights = dict(zip(keys, random.uniform(1.0, 1e3, len(keys))))
starts = dict.fromkeys(("motor", "joint"), np.array([0, 20, 40, 60]))
mask = dict.fromkeys(keys, np.ones(60, dtype=bool))
products = SimpleNamespace(mask=mask, weights=weights, rows=SimpleNamespace(starts=starts))
joined = {key: (values, np.arange(2)) for key, values in columns.items()}
print(BlockProducts._cross(products, columns, joined, np.arange(3), 2).tobytes().hex())
"""


def test_products_of_columns_do_not_depend_on_the_hash_seed() -> None:
    found = {
        subprocess.run(
            [sys.executable, "-c", _SCRIPT],
            env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in ("1", "2")
    }
    assert len(found) == 1
    assert all(len(text) > 100 for text in found)
