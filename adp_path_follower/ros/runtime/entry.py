"""Entry points, which take over the signals before they import rclpy for half a second."""

import functools
import importlib
import os
import signal
import sys
from types import FrameType

from adp_path_follower.extras import missing_text
from adp_path_follower.ros.runtime.stop_request import ending_signals
from adp_path_follower.threads import use_one_blas_thread


def _leave(number: int, frame: FrameType | None) -> None:
    os._exit(128 + number)  # nothing has been published yet, so nothing is left to say


def _main(module: str) -> None:
    for number in ending_signals():
        signal.signal(number, _leave)
    use_one_blas_thread()
    try:
        code = importlib.import_module(module).main()
    except ModuleNotFoundError as error:
        name = module.removesuffix(".path_process").removesuffix(".node").rpartition(".")[2]
        sys.exit(missing_text(f"the node {name}", "jazzy", str(error.name)))
    sys.exit(code)


# The console scripts of setup.py.
controller = functools.partial(_main, "adp_path_follower.ros.controller.path_process")
path_publisher = functools.partial(_main, "adp_path_follower.ros.path_publisher")
recorder = functools.partial(_main, "adp_path_follower.ros.recorder.node")
sim_unicycle = functools.partial(_main, "sim_unicycle.node")


if __name__ == "__main__":  # python -m adp_path_follower.ros.runtime.entry NODE [ARGUMENTS]
    {
        "controller": controller,
        "path_publisher": path_publisher,
        "recorder": recorder,
        "sim_unicycle": sim_unicycle,
    }[sys.argv.pop(1)]()
