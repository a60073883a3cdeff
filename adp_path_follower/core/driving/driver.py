"""Drives one robot and keeps its state across new paths, settings and restarts."""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.control.actuation import Actuation
from adp_path_follower.core.driving.arrival import Standstill, Turn
from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.driving.output import Counts, FollowerOutput
from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.geometry import FloatArray, tracking_error
from adp_path_follower.core.learning.weights_file import SavedWeights
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.progress import CARRIED, NOISE, Left, Place, new_start, next_place
from adp_path_follower.core.path.route import (
    Route,
    Segment,
    route_of,
    turned_command,
    turned_error,
    turned_pose,
    turned_settings,
)
from adp_path_follower.core.robot.robot import Robot
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import update

_NOTHING = Counts()


@dataclass(frozen=True)
class Change:
    """A change of settings that is ready to be taken over."""

    settings: Settings
    follower: PathFollower | None


class Driver:
    """Drive one robot, between changes of path and settings; the node and replay share it.

    A route's segments are followed one after the other: at the end of one the robot is told to
    stop, and when it stands still the next begins. Every change takes effect with the next step,
    so that a run is known from its steps and from the step that each change came after.

    Attributes:
        settings: All settings.
        route: The route to follow, None without one.
        segment: Number of the present segment.
        follower: The follower of that segment, None before the first step on the route. In reverse
            it is that of a robot which faces the other way (`core.path.route`).
        counts: Resets, restarts and stops so far.
        output: The follower's last output on the present segment, None before the first.
        saved_weights: Weights of another run to start from, None without.
        robot: The robot between this and the world.

    """

    def __init__(
        self,
        settings: Settings,
        saved_weights: SavedWeights | None = None,
        tell: Callable[[str], object] = bool,
        counts: Counts = _NOTHING,
        tell_start: Callable[[str], object] = bool,
    ) -> None:
        """Begin without a path, with the counts of before.

        Saved weights hold on some paths. `tell` is called with a sentence where they do not, or
        where a part of the path is left out, `tell_start` with where following begins otherwise.
        """
        self.settings = settings
        self.saved_weights, self._tell, self._tell_start = saved_weights, tell, tell_start
        self.route: Route | None = None
        self.counts = counts
        self.robot = Robot(settings, saved_weights.robot if saved_weights else ())
        self._actuation = Actuation()  # as the robot of the present segment is told
        self._faces_back = False  # that robot, other than the real one
        self.segment = 0
        self.follower: PathFollower | None = None
        self._pose: FloatArray = np.zeros(3)  # of the robot at the last step
        self._left: Left | None = None  # where following ended, until it goes on
        self._learned: PathFollower | None = None  # the follower of the path before
        self.output: FollowerOutput | None = None  # of the last step on the segment
        self._standstill: Standstill | None = None  # between segments
        self._turn: Turn | None = None  # on the spot
        self._faces_goal = False  # after the turn at the end of the route
        self._was_there = False  # at the end of the route, before it began
        self._to_learn = False  # from the last step
        self._tell_of_speed()

    def _tell_of_speed(self) -> None:
        speed, limit = self.settings.target.desired_speed, self.settings.limits.max_linear_vel
        if speed > limit:
            self._tell(
                f"'desired_speed' is {speed:g} m/s, but 'max_linear_vel' {limit:g}: the robot "
                f"drives at {limit:g} m/s"
            )

    @property
    def at_goal(self) -> bool:
        """Return whether the robot is at the end of an open route."""
        turned = self._faces_goal or self.route is None or self.route.goal_heading is None
        return self._at_segment_end and self._on_last_segment and turned and self._turn is None

    @property
    def _at_segment_end(self) -> bool:
        there = self.follower is not None and bool(self.follower.goal.reached)
        return there or self._was_there

    @property
    def _on_last_segment(self) -> bool:
        return self.route is not None and self.segment == len(self.route.segments) - 1

    @property
    def _present(self) -> Segment:
        assert self.route is not None  # the caller waits for one
        return self.route.segments[self.segment]

    def follow(self, path: Route | Path | None) -> None:
        """Follow another route, or a path, from the next step on, or none.

        One that is the present one but for its ends is gone on with.
        """
        learned = self._learned
        self._leave()
        self.route = None if path is None else route_of(path)
        if path is None:
            self._left, self._learned = None, learned

    def _leave(self) -> None:
        """Note where following ends."""
        if self.follower is not None and self.route is not None:
            place = Place(self.segment, float(self.follower.arc_length))
            self._left = Left(self.route, place, self._pose, self.at_goal)
            self._learned = self.follower
        self.follower, self.segment, self._standstill = None, 0, None
        self._turn, self._faces_goal, self._was_there = None, False, False

    def prepared(self, settings: Settings) -> Change:
        """Return the change to other settings, which `take_over` makes at once.

        Raises SettingsError if no policy can be found for them, or if the robot is on a route in
        reverse that they do not allow.
        """
        segments = () if self.route is None else self.route.segments
        if any(segment.reverse for segment in segments) and settings.limits.min_linear_vel >= 0.0:
            raise SettingsError(
                "setting 'min_linear_vel' is 0, but the present path is driven backwards: send "
                "another path first"
            )
        present = self.settings
        far = present.policy.wide_region  # which another may replace between two steps
        same_motion = dataclasses.replace(
            settings,
            controller=present.controller,
            navigation=present.navigation,
            path=present.path,
            policy=dataclasses.replace(settings.policy, wide_region=far),
        )
        if self.follower is None or same_motion == present:
            return Change(settings, self.follower)
        return Change(settings, self.follower.reconfigured(self._of_segment(settings)))

    def take_over(self, change: Change) -> None:
        """Go on with a change that was prepared since the last step."""
        before = self.settings
        self.settings, self.follower = change.settings, change.follower
        self.robot.take_over(change.settings)
        if (before.target, before.limits) != (change.settings.target, change.settings.limits):
            self._tell_of_speed()
        if self.follower is not None:
            self.follower.settings = self._of_segment(change.settings)

    def reset_learning(self) -> None:
        """Return to the initial weights of the settings, also where there were saved ones."""
        self._learned = self.saved_weights = None
        self._to_learn = False
        if self.follower is not None:
            self.follower.reset_learning()
        self.robot.reset()
        self._count(learning_resets=self.counts.learning_resets + 1)

    def restart(self) -> bool:
        """Look for the robot before it goes on: it was carried, perhaps; return if it had begun.

        Learned weights stay.
        """
        if self.follower is None:
            return False
        self._leave()
        self.robot.restart()
        self._count(restarts=self.counts.restarts + 1)
        return True

    def stopped(self) -> bool:
        """Note a stop of the robot; return whether it had another command before."""
        self.learn()  # first, lest the step before is learned from as one of a robot at rest
        if self._actuation.stopped:
            return False
        self._actuation.stop()
        self.robot.note(np.zeros(2))
        self._count(stops=self.counts.stops + 1)
        return True

    def catch_up(self, counts: Counts) -> None:
        """Reset learning, stop and restart where these counts differ, and take them over."""
        if counts.learning_resets != self.counts.learning_resets:
            self.reset_learning()
        if counts.stops != self.counts.stops:
            self.stopped()
        if counts.restarts != self.counts.restarts:
            self.restart()
        self.counts = counts

    def _count(self, **changed: int) -> None:
        self.counts = dataclasses.replace(self.counts, **changed)

    def step(self, pose: FloatArray, time: int, motion: FloatArray | None = None) -> FollowerOutput:
        """Return the command of `command_for`, and learn from the step."""
        output = self.command_for(pose, time, motion)
        self.learn()
        return output

    def learn(self) -> None:
        """Learn from the last step, once, if learning was not reset meanwhile."""
        if self._to_learn and self.follower is not None:
            self.follower.learn()
            self.robot.learn()
        self._to_learn = False

    def command_for(
        self, pose: FloatArray, time: int, motion: FloatArray | None = None
    ) -> FollowerOutput:
        """Return the command for a pose [x, y, theta] (3,) at a time [ns]; there must be a route.

        Command, error and target pose are the robot's own, also in reverse. Learning from
        the step waits for `learn`, so that the command can be sent before.

        Motion is odometry's v, w and age [s]; without it the robot's model is not used. Raises
        SettingsError if no policy can be found for these settings on this path.
        """
        moved = math.dist(pose[:2], self._pose[:2])
        if self._actuation.stopped and moved > CARRIED:
            self._leave()
            self.robot.restart()
        self._pose = pose
        ahead, then = self.robot.ahead(pose, time, motion)
        if self.follower is None:
            self._begin(pose)
            if then > time and self.follower is not None:
                facing = self._present.heading_of_path
                self.follower.lead(facing(pose), facing(ahead), (then - time) * 1e-9)
        elif self._at_segment_end and not self.at_goal and self._turn is None:
            self._standstill = self._standstill or Standstill()
            if not self._standstill.reached(pose, time):
                return self._resting(pose)
            self._standstill = None
            if self._on_last_segment:
                assert self.route is not None
                assert self.route.goal_heading is not None  # else it is at the goal
                self._turn = Turn(self.route.goal_heading, self.route.goal_turn, pose)
            else:
                self._learned = self.follower
                self._begin_segment(self.segment + 1, 0.0)
        if self._turn is not None:
            turning = self._turning(self._turn, pose, time)
            if turning is not None:
                return turning
        assert self.follower is not None  # one has just begun, if there was none
        self.follower.law.robot_is_ideal = self.robot.ideal
        self.follower.reference.keep_within(self.robot.acceleration)
        facing_ahead = self._present.heading_of_path(ahead)
        self.output = self.follower.step_at(facing_ahead, then, learn=False)
        self._to_learn = True
        output = self._own(self.output)
        command = self.robot.command(output.command)
        return output if command is output.command else dataclasses.replace(output, command=command)

    def _turning(self, turn: Turn, pose: FloatArray, time: int) -> FollowerOutput | None:
        """Return the output of a turn on the spot, None when driving begins."""
        assert self.follower is not None  # one has begun
        command = turn.command(pose, time, self._actuation, self.settings)
        if self.output is None:  # before the first step on the segment
            facing = self._present.heading_of_path(pose)
            self.output = self.follower.step_at(facing, time, learn=False)
            self.follower.hold()
            if command is not None:
                self._actuation.send(command, self.settings)
        if command is not None:
            return self._standing(pose, command)
        self._turn, self._faces_goal = None, self._at_segment_end
        return self._resting(pose) if self._faces_goal else None

    def _own(self, output: FollowerOutput) -> FollowerOutput:
        """Return an output in the real robot's terms, if its follower's faces the other way.

        The target pose has the heading that the robot should have, and curvature is positive to the
        robot's left.
        """
        if not self._present.reverse:
            return output
        return dataclasses.replace(
            output,
            command=turned_command(output.command),
            modified_input=turned_command(output.modified_input),
            error=turned_error(output.error),
            target_pose=turned_pose(output.target_pose),
            curvature=-output.curvature,
        )

    def _resting(self, pose: FloatArray) -> FollowerOutput:
        """Return zero velocity for a robot (3,) at the end of a segment, and how far it is off."""
        if not self._actuation.stopped:
            self._actuation.stop()
        return self._standing(pose, np.zeros(2))

    def _standing(self, pose: FloatArray, command: FloatArray) -> FollowerOutput:
        """Return a command [0, w] and its error at a pose (3,), without heading while it turns."""
        last = self.output
        assert last is not None  # there was a step on the segment
        self.robot.note(command)
        error = tracking_error(self._present.heading_of_path(pose), last.target_pose)
        if self._turn is not None or self._faces_goal:
            error = error * np.array([1.0, 1.0, 0.0])
        turned = last.modified_input - last.command + command
        return self._own(
            dataclasses.replace(last, command=command, modified_input=turned, error=error)
        )

    def _of_segment(self, settings: Settings) -> Settings:
        if self.robot.measured and settings.robot.robot_model != "ideal":  # and its delay predicted
            settings = update(settings, {"actuation_delay": 0.0})
        return turned_settings(settings) if self._present.reverse else settings

    def _begin(self, pose: FloatArray) -> None:
        route, left, controller = self.route, self._left, self.settings.controller
        assert route is not None  # the caller waits for one
        place = None if left is None else next_place(route, pose, left)
        goes_on = place is not None
        place = place or new_start(route, pose, controller)
        along = place.along(route)
        text = f"{'goes on' if goes_on else 'begins'} at {along:.1f} of {route.length:.1f} m"
        chosen = goes_on or route.closed or controller.path_start == "arc_length"
        if along > NOISE and not chosen:
            self._tell(f"{text}: the path before is left out, unless path_start is 'beginning'")
        else:
            self._tell_start(text)
        last, end = len(route.segments) - 1, route.segments[-1].path
        off = math.dist(end.frame(end.length).pose[:2], pose[:2])
        short = max(off, route.length) <= self.settings.motion.xy_goal_tolerance
        self._was_there = short and not route.closed
        if self._was_there:
            place = Place(last, end.length)
        self._begin_segment(place.segment, place.arc_length)
        self._left = None
        if self._was_there:
            # It only remains to brake and to turn: so short a path shows no direction, as it leads
            # from where a planner saw the robot to where the robot already is.
            wanted = float(pose[2]) if route.goal_heading is None else route.goal_heading
            self._turn = Turn(wanted, 0.0, pose)

    def _begin_segment(self, number: int, arc_length: float) -> None:
        self.segment = number
        segment = self._present
        if segment.reverse is not self._faces_back:
            self._actuation.turn_round()
            self._faces_back = segment.reverse
        settings = self._of_segment(self.settings)
        follower = PathFollower(settings, segment.path, arc_length, actuation=self._actuation)
        if self.saved_weights is not None:
            problem = follower.start_from(self.saved_weights)
            if problem:
                self._tell(
                    f"the weights of 'weights_file' are not used on this path: {problem}; learning "
                    "starts from the initial weights"
                )
        if self._learned is not None:
            follower.take_over(self._learned)
        self.follower, self._learned, self.output = follower, None, None
        self._to_learn = False
        if segment.turn_first and arc_length <= NOISE:
            begin = segment.heading_of_path(segment.path.frame(0.0).pose)
            self._turn = Turn(float(begin[2]), segment.turn, self._pose)
