"""Feed what a recorded run measured to `PathFollower` again, and compare what comes out."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from adp_path_follower.bags.columns import Series
from adp_path_follower.bags.reader import Run
from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.driving.output import FollowerOutput
from adp_path_follower.core.errors import FileError
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.drawing.charts import RunView
from adp_path_follower.study.replay.recorded_driver import RecordedDriver, recorded_settings
from sim_unicycle.settings import PlantSettings
from sim_unicycle.unicycle import Unicycle

_NEIGHBOURS = np.arange(-10, 10)  # commands about the one that arrived with a step
_BEGINNING = 1_000_000_000  # [ns] in which a recording may lack commands
_LATE = 100_000_000  # [ns] beyond the usual: a pose that was delivered long after it was published
_NANOSECONDS = 1_000_000_000
_KINDS = ("critic", "actor")


@dataclass(frozen=True)
class Steps:
    """The control steps of a run."""

    stamp: np.ndarray  # time of each [ns], shape (N,)
    pose: FloatArray  # x, y, theta that it went by, shape (N, 3)
    arrival: np.ndarray  # when that was recorded [ns], shape (N,)
    motion: FloatArray  # v, w and age of the odometry [s], NaN where unknown, shape (N, 3)


@dataclass(frozen=True)
class Replay:
    """The replay of a run by `PathFollower`."""

    follower: PathFollower  # the follower after the run, of the last segment that was driven
    settings: Settings  # the settings after the run
    steps: Steps  # the control steps, N of them
    recorded: FloatArray  # the commands [v, w] in the bag, NaN where a step has none, shape (N, 2)
    outputs: list[FollowerOutput]  # outputs of the follower, one for each step
    cost: FloatArray  # J at each step, shape (N,)
    # Number of a step and what the controller would have said before it, of the first and of each
    # that something changed before.
    configurations: tuple[tuple[int, str], ...]

    @classmethod
    def by(cls, driver: RecordedDriver, steps: Steps, recorded: FloatArray) -> Self:
        """Return the replay that a driver has made."""
        assert driver.follower is not None  # there was a step
        said, cost = tuple(driver.configurations), np.array(driver.costs)
        return cls(driver.follower, driver.settings, steps, recorded, driver.outputs, cost, said)

    @property
    def time(self) -> FloatArray:
        """Return the time of each step since the first [s], shape (N,)."""
        return np.asarray((self.steps.stamp - self.steps.stamp[0]) * 1e-9)

    @property
    def answered(self) -> np.ndarray:
        """Return which steps have a recorded command, shape (N,)."""
        return np.asarray(np.isfinite(self.recorded).all(axis=1))

    @property
    def identical(self) -> np.ndarray:
        """Return for each step whether both commands are equal to the last bit, shape (N,)."""
        return np.asarray((self.replayed == self.recorded).all(axis=1))

    @property
    def replayed(self) -> FloatArray:
        """Return the follower's commands [v, w], shape (N, 2)."""
        return np.array([output.command for output in self.outputs])


def replay(
    run: Run, settings: Settings | None = None, overlay: Mapping[str, object] | None = None
) -> Replay:
    """Replay a run with the steps, the paths and the changes of parameters that it had.

    A run of this package's controller holds the pose of each step; else each odometry message is a
    step. `settings` are the recorded ones by default; `overlay` maps a setting to the value that
    replaces them all the time. Raises FileError if the bag lacks odometry, path or configuration,
    or a pose is impossible; SettingsError if the overlay does not fit.
    """
    steps = steps_of(run)
    if settings is None and "measured_pose" not in run.series:
        settings = recorded_settings(run) if overlay else _settings_of_odometry_steps(run)
    driver = RecordedDriver(run, settings, overlay)
    answered = []
    for pose, stamp, motion in zip(steps.pose, steps.stamp.tolist(), steps.motion, strict=True):
        answered.append(driver.taken(pose, stamp, motion) is not None)
        if driver.at_goal and "measured_pose" not in run.series:
            break  # from here on the node commands zero velocity
    if not driver.outputs:
        raise FileError("no step of the bag has a command: its settings allow none on its path")
    chosen = np.flatnonzero(answered)
    steps = Steps(*(values[chosen] for values in vars(steps).values()))
    commands = np.array([output.command for output in driver.outputs])
    recorded = _recorded(run.series.get("cmd_vel"), steps, commands)
    return Replay.by(driver, steps, recorded)


def steps_of(run: Run) -> Steps:
    """Return the control steps of a run; FileError if there are none, or poses are not finite."""
    series = run.series.get("measured_pose", run.series.get("odom"))
    if series is None:
        wanted = "name a topic of nav_msgs/msg/Odometry by --odom"
        raise FileError(f"the bag has no odometry: {wanted}{run.causes}")
    # The simulator repeats odometry that was not answered in time: the first of each stamp counts.
    stamps, first = np.unique(series.stamp, return_index=True)
    if series is run.series.get("odom") and "cmd_vel" in run.series:
        # Only what was answered was a step, where commands say what they answer.
        answered = np.isin(stamps, run.series["cmd_vel"].stamp)
        if answered.any():
            stamps, first = stamps[answered], first[answered]
    pose = series.values[first][:, :3]
    if not np.isfinite(pose).all():
        raise FileError("the bag has odometry that is not finite: it cannot be replayed")
    motion = np.full_like(pose, np.nan)
    if "measured_motion" in run.series:
        told, where = np.unique(run.series["measured_motion"].stamp, return_index=True)
        _, step, telling = np.intersect1d(stamps, told, return_indices=True)
        motion[step] = run.series["measured_motion"].values[where[telling]]
        if len(step) and step[-1] == len(pose) - 2:  # the recording ended within the last step
            stamps, first, pose, motion = stamps[:-1], first[:-1], pose[:-1], motion[:-1]
    elif series is run.series.get("odom"):
        motion = np.column_stack([series.values[first][:, 3:5], np.zeros(len(pose))])
    return Steps(stamps, pose, series.arrival[first], motion)


def _settings_of_odometry_steps(run: Run) -> Settings:
    """Return the recorded settings of a run whose steps were its odometry; else raise FileError."""
    settings = recorded_settings(run)
    if settings.controller.control_trigger != "odometry":
        raise FileError(
            "the bag does not say which pose each step went by (path_follower/measured_pose), and "
            "its steps were not those of the odometry: replay it with --params"
        )
    return settings


def _recorded(commands: Series | None, steps: Steps, replayed: FloatArray) -> FloatArray:
    """Return the recorded command of each step, NaN where there is none, shape (N, 2)."""
    found = np.full(replayed.shape, np.nan)
    if commands is None:
        return found
    if not np.array_equal(commands.stamp, commands.arrival):
        # The zero velocities of a stop can have the stamp of the step before or after them.
        stops = ~commands.values.any(axis=1)
        order = np.lexsort((stops, commands.stamp))
        stamps, first = np.unique(commands.stamp[order], return_index=True)
        _, in_steps, in_commands = np.intersect1d(steps.stamp, stamps, return_indices=True)
        found[in_steps] = commands.values[order[first[in_commands]]]
        return found
    # Without stamps: of those that arrived about then, the one that comes nearest. A recorder that
    # joins late gets the poses from before, all at once, but not the commands.
    place = np.searchsorted(commands.arrival, steps.arrival)[:, None] + _NEIGHBOURS
    near = commands.values[np.clip(place, 0, len(commands.stamp) - 1)]
    apart = np.abs(near - replayed[:, None]).sum(axis=2)
    delay = steps.arrival - steps.stamp
    usual = delay <= np.median(delay) + _LATE
    found[usual] = near[np.arange(len(near)), apart.argmin(axis=1)][usual]
    # Nor those before the first that it heard, which are then compared with others.
    same = np.flatnonzero((found == replayed).all(axis=1))
    early = steps.arrival < commands.arrival[0] + _BEGINNING
    if len(same):
        found[: same[0]][early[: same[0]]] = np.nan
    return found


def rerun(
    run: Run, settings: Settings | None = None, overlay: Mapping[str, object] | None = None
) -> tuple[Replay, FloatArray]:
    """Return a run of the simulator from the recorded initial pose, as long as the recorded one.

    Paths and changes of parameters come when they came; `settings` and `overlay` are as in
    `replay`, as are the errors raised. The robot is the ideal unicycle. Returns the run, in which
    no command is a recorded one, and v, w at each step, shape (N, 2).
    """
    recorded = steps_of(run)
    if settings is None and "measured_pose" not in run.series:
        settings = recorded_settings(run)  # such a bag does not say which steps a change is between
    driver = RecordedDriver(run, settings, overlay)
    stamp, last = int(recorded.stamp[0]), int(recorded.stamp[-1])
    robot = Unicycle(recorded.pose[0], PlantSettings())
    stamps: list[int] = []
    poses, velocities = [], []
    while stamp <= last and not (stamps and driver.at_goal):
        pose, twist = robot.measured_pose(), robot.twist
        output = driver.taken(pose, stamp, np.append(twist, 0.0))
        if output is not None:
            stamps.append(stamp)
            poses.append(pose)
            velocities.append(twist)
        period = 1.0 / driver.settings.controller.controller_frequency
        robot.step(np.zeros(2) if output is None else output.command, period)
        stamp += round(period * _NANOSECONDS)
    count = len(stamps)
    stamp_array = np.array(stamps)
    arrival = recorded.arrival[0] + stamp_array - stamp_array[0]
    motion = np.column_stack([velocities, np.zeros(count)])
    steps = Steps(stamp_array, np.array(poses), arrival, motion)
    nothing = np.full((count, 2), np.nan)
    return Replay.by(driver, steps, nothing), np.array(velocities)


def view_of_replay(run: Run, replay: Replay) -> RunView:
    """Return the view of a recorded run: its weights as recorded, the rest as replayed."""
    start, time = replay.steps.stamp[0], replay.time
    nothing = Series(np.zeros(0, dtype=np.int64), np.zeros((0, 0)))
    critic = run.series.get("critic_weights", nothing)
    actor = run.series.get("actor_weights", nothing)
    count = min(len(critic.stamp), len(actor.stamp))
    # Weights carry no stamp. With one message for each step they belong to the steps in order;
    # else the time of their arrival, which lags, must do.
    every_step = count == len(time)
    return RunView(
        time=time,
        path=replay.follower.path.points(0.05)[:, :2],
        track=replay.steps.pose,
        target=np.array([output.target_pose[:2] for output in replay.outputs]),
        error=np.array([output.error for output in replay.outputs]),
        modified_input=np.array([output.modified_input for output in replay.outputs]),
        weight_time=time if every_step else (critic.stamp[:count] - start) * 1e-9,
        critic_weights=critic.values[:count],
        actor_weights=actor.values[:count],
        labels=critic.labels,
    )


@dataclass(frozen=True)
class ComparedWeights:
    """How recorded and replayed weights compare."""

    # For each recorded set whether it comes out the same to the last bit, those of the critic
    # first, shape (N,); no rows where there is nothing to compare.
    identical: np.ndarray
    difference: str  # a sentence about the first one that differs, empty without one
    notes: tuple[str, ...]  # sentences about data that were not compared


def compare_weights(run: Run, found: Replay) -> ComparedWeights:
    """Return how the weights in a run compare with those of its replay."""
    same: list[np.ndarray] = []
    differences: list[tuple[int, str]] = []  # step, and what differs most in it
    notes: list[str] = []
    for kind in _KINDS:
        recorded = run.series.get(f"{kind}_weights")
        if recorded is None:
            continue
        replayed = np.array([getattr(output.weights, kind) for output in found.outputs])
        count, columns = recorded.values.shape
        if columns != replayed.shape[1]:
            same.append(np.zeros(count, dtype=bool))
            name = f"number of {kind} weights"
            differences.append((0, _apart(name, columns, replayed.shape[1])))
        elif count > len(replayed):
            notes.append(
                f"the bag has {count} sets of {kind} weights for {len(replayed)} steps: not "
                "compared, as it is not known which belong together"
            )
        else:
            steps, equal = _matched(recorded, replayed, found.steps.arrival)
            same.append(equal)
            if not equal.all():
                row = int(np.argmin(equal))
                step, before = int(steps[row]), recorded.values[row]
                with np.errstate(all="ignore"):  # a damaged message may hold anything
                    place = int(np.argmax(np.abs(before - replayed[step])))  # a NaN before all
                known = place < len(recorded.labels)
                name = f"{kind} weight {recorded.labels[place] if known else place + 1}"
                values = float(before[place]), float(replayed[step, place])
                differences.append((step, _apart(name, *values)))
    identical = np.concatenate(same) if same else np.zeros(0, dtype=bool)
    if not differences:
        return ComparedWeights(identical, "", tuple(notes))
    step, apart = min(differences, key=lambda item: item[0])
    after = f"first difference of weights after {found.time[step]:.3f} s"
    return ComparedWeights(identical, f"{after}: {apart}", tuple(notes))


def _apart(name: str, recorded: float, replayed: float) -> str:
    return (
        f"{name} is recorded as {recorded:.6g}, replayed as {replayed:.6g}, "
        f"{abs(replayed - recorded):.3g} apart"
    )


def _matched(
    recorded: Series, replayed: FloatArray, arrival: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the step that each recorded set belongs to, and whether both are the same, (N,) each.

    Weights carry no stamp: a set belongs to the next step with the same, else to the last pose
    before.
    """
    values = recorded.values
    if len(values) == len(replayed):
        return np.arange(len(values)), np.asarray((values == replayed).all(axis=1))
    steps = np.searchsorted(arrival, recorded.arrival, side="right") - 1
    steps = np.clip(steps, 0, len(replayed) - 1)
    same = np.zeros(len(values), dtype=bool)
    places: dict[bytes, list[int]] = {}
    for step in reversed(range(len(replayed))):  # so that the earliest comes off the end
        places.setdefault((replayed[step] + 0.0).tobytes(), []).append(step)  # -0.0 is 0.0
    following = 0
    for row, value in enumerate(values):
        fitting = places.get((value + 0.0).tobytes(), [])
        while fitting and fitting[-1] < following:
            fitting.pop()
        if fitting:
            steps[row], same[row] = fitting[-1], True
            following = fitting[-1] + 1
    return steps, same
