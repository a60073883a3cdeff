"""How far the numbers of a run can be trusted: what was used, what was left out, and why."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from adp_path_follower.analysis.recorded_run import Drive

_GAP = 1.0  # [s] without odometry, and ...
_GAP_PERIODS = 10.0  # ... times its usual period: the robot's place is not known
_ENOUGH = 0.5  # share of what a number is made of that must be there
_FEWEST = 10  # poses
_NEED_COMMANDS = ("linear_", "angular_", "command_", "latency_", "cost")
_NEED_NOTHING = ("messages", "time_in_state.", "duration")
_NEED_PLACES = (
    "path_covered", "cross_track_", "heading_", "steady_", "approach_time", "overshoot", "cost",
    "optimal_cost",
)  # fmt: skip


@dataclass(frozen=True)
class Trust:
    """The data behind the numbers of a run; page, terminal and metrics.json say the same."""

    odometry_used: int  # messages that count, ...
    odometry_total: int  # ... and those in the bag
    commands_used: int
    commands_total: int
    stamps: float  # [s] from the least to the greatest stamp of the odometry
    arrivals: float  # [s] from its first to its last arrival
    by_arrival: bool  # the stamps were of no use
    cuts: int  # how often time was set back or ahead
    bag: float  # [s] from the first to the last message of the bag
    duration: float  # [s] during which the robot was told to move, ...
    measured: float  # ... and its place is known
    poses: int  # odometry messages during that time, ...
    compared: int  # ... and those whose place beside the path is known
    distance: float  # [m]
    path_covered: float  # [m], NaN if no place is known
    jumps: int  # steps of the odometry that no robot drives; they count for nothing
    path_frame: str
    odometry_frame: str

    def sentences(self) -> tuple[str, ...]:
        """Return what people should know before they believe a number."""
        jumps = f", {self.jumps} jumps left out" if self.jumps else ""
        cuts = f", cut {self.cuts} times" if self.cuts else ""
        clock = "by arrival" if self.by_arrival else "by stamps"
        frames = f"path '{self.path_frame}', odometry '{self.odometry_frame}'"
        apart = "" if self.compared == self.poses else f"; {self._compared()}"
        covered = f"{self.path_covered:.2f} m" if self.compared else "an unknown way"
        return (
            f"{self.odometry_used} of {self.odometry_total} odometry messages and "
            f"{self.commands_used} of {self.commands_total} commands used",
            f"stamps over {self.stamps:.1f} s, arrivals over {self.arrivals:.1f} s: {clock}{cuts}",
            f"told to move for {self.duration:.1f} s of the bag's {self.bag:.1f} s, place known "
            f"for {self.measured:.1f} s",
            f"drove {self.distance:.2f} m, {covered} along the path{jumps}",
            f"frames: {frames}{apart}",
        )

    def doubt(self, name: str) -> str:
        """Return why a number was hardly measured, empty if it was."""
        if name.startswith(_NEED_NOTHING):
            return ""
        if name.startswith(_NEED_COMMANDS):
            if self.commands_used < _ENOUGH * self.commands_total:
                return f"{self.commands_used} of {self.commands_total} commands could be used"
            if not name.startswith("cost"):
                return ""
        if self.odometry_used < _ENOUGH * self.odometry_total:
            return f"{self.odometry_used} of {self.odometry_total} odometry messages could be used"
        if self.poses < _FEWEST:
            return f"there are {self.poses} poses while the robot was told to move"
        if name.startswith(_NEED_PLACES) and self.compared < _ENOUGH * self.poses:
            return self._compared()
        if self.measured < _ENOUGH * self.duration:
            return (
                f"the robot's place is known for {self.measured:.1f} of {self.duration:.1f} s only"
            )
        return ""

    def _compared(self) -> str:
        return f"{self.compared} of {self.poses} poses could be compared with the path"


def trust_of(drive: Drive, metrics: Mapping[str, float]) -> Trust:
    """Return how far the numbers of a drive can be trusted."""
    run, odometry, commands = drive.run, drive.timelines["odom"], drive.timelines["cmd_vel"]
    found = run.series["odom"]
    driving = drive.driving

    def total(key: str) -> int:
        return run.message_counts.get(run.topics.get(key, ""), 0)

    return Trust(
        odometry_used=odometry.used,
        odometry_total=max(total("odom"), odometry.used),
        commands_used=commands.used,
        commands_total=max(total("cmd_vel"), commands.used),
        stamps=_span(found.stamp),
        arrivals=_span(found.arrival),
        by_arrival=odometry.by_arrival,
        cuts=int(odometry.cut.sum()),
        bag=_span(np.array(run.span, dtype=np.int64)),
        duration=float(drive.end),
        measured=_measured(drive),
        poses=int(driving.sum()),
        compared=int((driving & drive.compared).sum()),
        distance=metrics["distance"],
        path_covered=metrics["path_covered"],
        jumps=int((drive.motion.carried & ~odometry.cut & driving).sum()),
        path_frame=drive.frames[0],
        odometry_frame=drive.frames[1],
    )


def _span(times: np.ndarray) -> float:
    return float(np.ptp(times) * 1e-9) if len(times) else 0.0


def _measured(drive: Drive) -> float:
    """Return for how long the robot's place is known while it was told to move [s]."""
    time = drive.odometry.time[drive.driving]
    if not len(time):
        return 0.0
    steps = np.diff(np.concatenate([[0.0], time, [max(drive.end, time[-1])]]))
    usual = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    gaps = steps > max(_GAP, _GAP_PERIODS * usual)
    return float(drive.end - steps[gaps].sum())
