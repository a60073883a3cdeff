"""One thread for BLAS, decided before numpy is imported.

The matrices here are small: more threads only wait for each other. And how many there are decides
in what order a product is summed, so that two processes agree to the last bit only if both have
the same number.
"""

import os


def use_one_blas_thread() -> None:
    """Let numpy use one thread; call it before numpy is imported."""
    for library in ("OMP", "OPENBLAS", "MKL"):
        os.environ[f"{library}_NUM_THREADS"] = "1"
