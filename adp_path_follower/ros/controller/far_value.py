"""The value function far from the path, found by a process beside the node while the robot drives.

Until it is there, `wide_region: approach` drives. The settings that the node says it drives with
change then, as if a parameter had, and so do those of a replay.
"""

import dataclasses
import os
import threading
from multiprocessing import parent_process
from multiprocessing.context import SpawnContext
from multiprocessing.process import BaseProcess

import numpy as np
from rclpy.impl.rcutils_logger import RcutilsLogger

from adp_path_follower.core.control.far_from_path import far_levels, far_policy_of
from adp_path_follower.core.control.value_iteration import ValueProblem
from adp_path_follower.core.control.value_store import problem_of, store, stored
from adp_path_follower.core.driving.driver import Driver
from adp_path_follower.core.path.reversing import turned_settings
from adp_path_follower.core.settings.groups import Settings

_NICE = 10  # control and paths come first


class FarValue:
    """Has the value function found as soon as the robot is far from the path."""

    def __init__(self, log: RcutilsLogger) -> None:
        """Take whom to tell."""
        self._log = log
        self._process: BaseProcess | None = None
        self._sought: tuple[ValueProblem, ...] = ()  # by the process, or in vain

    def drivable(self, wanted: Settings) -> Settings:
        """Return the settings to drive with now, where some are wanted."""
        if not _missing(wanted):
            return wanted
        policy = dataclasses.replace(wanted.policy, wide_region="approach")
        return dataclasses.replace(wanted, policy=policy)

    def has_come(self, driver: Driver, wanted: Settings) -> bool:
        """Return whether a driver can take the wanted settings; far away, start to find them."""
        if wanted.policy.wide_region == driver.settings.policy.wide_region:
            return False
        if self._process is None:
            widths = np.array(wanted.learning.sample_half_widths[:3])
            error = np.zeros(3) if driver.output is None else driver.output.error
            if not (np.abs(error) > far_levels(wanted)[0] * widths).any():
                return False
            missing = _missing(wanted)
            if missing and missing != self._sought:
                self._start(missing)
            return not missing
        if not self._process.is_alive():
            code, self._process = self._process.exitcode, None
            if any(stored(problem) is None for problem in self._sought):
                self._log.warning(
                    f"the value function far from the path was not found (exit code {code}): "
                    "wide_region 'approach' drives; check that ~/.cache can be written"
                )
            else:
                self._log.info("found the value function far from the path")
        return False

    def destroy(self) -> None:
        """End the process, whatever it is at."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._process = None

    def _start(self, missing: tuple[ValueProblem, ...]) -> None:
        self._sought = missing
        self._log.info(
            "far from the path: wide_region 'approach' drives until the value function is found, "
            "which takes some ten seconds, once for these settings"
        )
        process = SpawnContext().Process(target=_find, args=(missing,), daemon=True)
        try:
            process.start()
        except OSError as error:
            self._log.warning(f"the value function far from the path cannot be found: {error}")
            return
        self._process = process


def _missing(settings: Settings) -> tuple[ValueProblem, ...]:
    """Return what has to be found before `wide_region: value_grid` can drive."""
    if far_policy_of(settings) != "value_grid":
        return ()
    problems = [problem_of(settings)]
    if settings.path.allow_reversing and settings.limits.min_linear_vel < 0.0:
        problems.append(problem_of(turned_settings(settings)))
    return tuple(problem for problem in problems if stored(problem) is None)


def _find(problems: tuple[ValueProblem, ...]) -> None:
    """Find and store value functions, in a process of its own that ends with the node."""
    os.nice(_NICE)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    for problem in problems:
        store(problem)


def _end_with_parent() -> None:
    parent = parent_process()
    assert parent is not None  # the node
    parent.join()
    os._exit(1)
