"""What holds for all tests."""

from adp_path_follower.threads import use_one_blas_thread

use_one_blas_thread()  # as the executables do; before anything imports numpy
