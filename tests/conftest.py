"""Shared by all tests: one thread per process, since tests run side by side on few cores."""

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "LP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # read when the libraries are first imported
