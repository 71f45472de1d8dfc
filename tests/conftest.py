"""Settings that hold for all tests."""

import os

# Before numpy is imported: the matrices are small, and test processes run side by side.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
