"""The open trainer for point-based clothed avatars."""

import os
import sys

__version__ = "0.1.0"

# Idle OpenMP threads look for work for some microseconds and then sleep. Where processes share cores, threads that spin
# without end make a training step many times slower; threads that sleep at once have to be woken for each of its many
# small pieces of work, a fifth of its time. OpenMP reads both when torch is first imported, so they stand here, before
# any module of the package; where torch came first they are too late, and `environment.prepared_process` says so.
TOO_LATE = "torch" in sys.modules and "OMP_WAIT_POLICY" not in os.environ
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ["OMP_WAIT_POLICY"] = "PASSIVE"
    os.environ.setdefault("GOMP_SPINCOUNT", "10000")
