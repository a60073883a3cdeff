"""The settings of a controller among others: goals of Nav2, progress and moving frames."""

from dataclasses import dataclass

from adp_path_follower.core.settings.schema import POSITIVE, limit, setting


@dataclass(frozen=True)
class NavigationSettings:
    """Navigation."""

    controller_ids: tuple[str, ...] = setting(
        ("FollowPath",),
        "Values of controller_id that goals of follow_path may have, beside the empty text.",
    )
    goal_checker_ids: tuple[str, ...] = setting(
        ("general_goal_checker",),
        "The same for goal_checker_id; any of them means the goal tolerances above.",
    )
    progress_checker_ids: tuple[str, ...] = setting(
        ("progress_checker",), "The same for progress_checker_id."
    )
    failure_tolerance: float = setting(
        1.0,
        "How long the robot may stand for a fault, or for want of odometry or of a transform, "
        "before a goal of follow_path is aborted.",
        unit="s",
        low=0.0,
    )
    transform_tolerance: float = setting(
        1.0,
        "Age at which the transform between odometry and the frame of the path is refused.",
        unit="s",
        low=POSITIVE,
    )
    max_correction: tuple[float, float] = setting(
        (1.0, 0.5),
        "Distance and turn by which that transform may correct the robot's pose at once; beyond, "
        "the robot is told to stop until ~/resume is called.",
        unit="m, rad",
        low=0.0,
    )
    required_movement_radius: float = setting(
        0.5, "Distance that counts as progress.", unit="m", low=POSITIVE
    )
    movement_time_allowance: float = limit(
        "Time without progress after which the robot is told to stop and a goal is aborted, while "
        "a path is followed. .inf waits for ever.",
        unit="s",
    )
