"""What holds for all tests."""

from adp_path_follower.threads import use_one_blas_thread

use_one_blas_thread()  # as the executables do; before anything imports numpy

import os

import hypothesis

# The same examples on every machine and in every run; HYPOTHESIS_PROFILE=search looks for others.
hypothesis.settings.register_profile("repeatable", derandomize=True)
hypothesis.settings.register_profile("search", derandomize=False)
hypothesis.settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeatable"))
