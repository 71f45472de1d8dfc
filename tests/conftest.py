"""Settings that hold for all tests."""

import os
import signal

from hypothesis import settings

# Before numpy is imported: the matrices are small, and test processes run side by side.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# No test asserts a wall-clock time: a busy computer is not a failure.
settings.register_profile("project", deadline=None)
settings.load_profile("project")

# A shell starts what runs in its background with Ctrl-C ignored, and children inherit that; some tests press Ctrl-C.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
