"""Commands and odometry of bags, as identification needs them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np

from adp_path_follower.analysis.stamps import Clock, timeline
from adp_path_follower.bags.columns import Series
from adp_path_follower.bags.reader import read_run
from adp_path_follower.core.errors import FileError
from adp_path_follower.core.geometry import FloatArray

_LONGEST = 600.0  # [s] of driving that is used of one bag
_BEFORE, _AFTER = 1.0, 2.0  # [s] of odometry around the commands to move
_FLOOR = 1e-9  # [m/s, rad/s] of a command or of a measured velocity
_ANOTHER_CLOCK = 1.0  # [s] between stamp and arrival


@dataclass(frozen=True)
class Recording:
    """Commands and odometry on one clock."""

    sent: FloatArray  # times of the commands [s], shape (C,)
    commands: FloatArray  # [m/s, rad/s], shape (C, 2)
    time: FloatArray  # of the measurements [s], shape (N,)
    poses: FloatArray  # x, y, theta, shape (N, 3)
    encoders: FloatArray  # v, w, shape (N, 2)
    localised: bool  # whether the poses are from another topic than the encoders
    latency: FloatArray  # arrival less stamp [s], empty where the recorder's clock is another
    notes: tuple[str, ...]  # sentences about data that could not be used


def read_recording(bag: FilePath, topics: Mapping[str, str]) -> Recording:
    """Return what a bag tells of its robot.

    `topics` maps "odom", "cmd_vel" and "ground_truth" (odometry with a better pose) to topics of
    the bag. Raises FileError if it cannot be read, or has no odometry with velocities or no
    command to move.
    """
    run = read_run(bag, {"path": "", "ground_truth": "", **topics})
    for key, kind, option in (("odom", "odometry", "--odom"), ("cmd_vel", "commands", "--cmd")):
        if key not in run.series:
            raise FileError(f"bag {bag} has no {kind}: name a topic by {option}, or record it")
    line = timeline(run.series["odom"], "odometry")
    clock = Clock(line)
    told = timeline(run.series["cmd_vel"], "commands", clock)
    moving = told.series.stamp[np.abs(told.series.values).max(axis=1, initial=0.0) > _FLOOR]
    if not len(moving):
        raise FileError(f"bag {bag} has no command to move: record the robot while it drives")
    start = int(moving[0])
    time = (line.series.stamp - start) * 1e-9
    end = min(float(moving[-1] - start) * 1e-9, _LONGEST)
    used = (time >= -_BEFORE) & (time <= end + _AFTER)
    values = line.series.values[used]
    if not np.abs(values[:, 3:]).max(initial=0.0) > _FLOOR:
        raise FileError(
            f"bag {bag} has no odometry with velocities while the robot drives: record one that "
            "has, or name it by --odom"
        )
    poses = values[:, :3]
    if "ground_truth" in topics:
        poses = _poses_at(line.series.stamp[used], run.series["ground_truth"])
    late = (line.all_arrivals - line.all_stamps) * 1e-9
    same_clock = not line.by_arrival and abs(float(np.median(late))) < _ANOTHER_CLOCK
    return Recording(
        sent=(told.series.stamp - start) * 1e-9,
        commands=told.series.values,
        time=time[used],
        poses=np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])]),
        encoders=values[:, 3:],
        localised="ground_truth" in topics,
        latency=late if same_clock else np.zeros(0),
        notes=(*run.notes, *line.notes, *told.notes),
    )


def _poses_at(stamps: np.ndarray, truth: Series) -> FloatArray:
    """Return the poses at stamps [ns] of another odometry, shape (N, 3)."""
    order = np.argsort(truth.stamp, kind="stable")
    values = np.column_stack([truth.values[order, :2], np.unwrap(truth.values[order, 2])])
    known = (truth.stamp[order] - stamps[0]).astype(float)
    asked = (stamps - stamps[0]).astype(float)
    return np.column_stack([np.interp(asked, known, column) for column in values.T])
