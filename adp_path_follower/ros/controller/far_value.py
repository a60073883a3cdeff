"""The settings to drive with far from the path, while the value function is not stored."""

import dataclasses

from adp_path_follower.core.control.far_from_path import far_policy_of
from adp_path_follower.core.control.value_store import problem_of, stored
from adp_path_follower.core.path.reversing import turned_settings
from adp_path_follower.core.settings.groups import Settings


def drivable(wanted: Settings) -> Settings:
    """Return the settings to drive with, where some are wanted: no control step finds a value.

    `wide_region: approach` stands for `value_grid` until `adp simulate` has stored its values.
    """
    if far_policy_of(wanted) != "value_grid":
        return wanted
    problems = [problem_of(wanted)]
    if wanted.path.allow_reversing and wanted.limits.min_linear_vel < 0.0:
        problems.append(problem_of(turned_settings(wanted)))
    if all(stored(problem) is not None for problem in problems):
        return wanted
    policy = dataclasses.replace(wanted.policy, wide_region="approach")
    return dataclasses.replace(wanted, policy=policy)
