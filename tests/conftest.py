"""Shared by all tests: one thread per process, since tests run side by side on few cores."""

import os
import signal

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "LP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # read when the libraries are first imported

# A shell's background jobs ignore Ctrl-C and hand that down; tests send it to their children.
signal.signal(signal.SIGINT, signal.default_int_handler)
