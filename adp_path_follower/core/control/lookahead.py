"""The far policy improved on the path as it is, while it drives.

A value function on a grid knows circles only. So the motion that its policy begins is driven ahead
in thought along the path that comes, and improved by `dynamic_programming`. The improved policy
drives as soon as its motion costs less than the one before, and is the next to be improved.
"""

from collections.abc import Generator

import numpy as np

from adp_path_follower.core.control.dynamic_programming import (
    Feedback,
    MotionModel,
    Policy,
    State,
)
from adp_path_follower.core.control.far_from_path import WideRegion
from adp_path_follower.core.control.policy import saturate
from adp_path_follower.core.control.riccati import RiccatiSchedule
from adp_path_follower.core.geometry import FloatArray, anywhere, number, numbers
from adp_path_follower.core.settings.groups import Settings

_CHANGE_TIME = 1.0  # [s] from one wide region to another
_EASED = 0.1  # [s] from one policy far from the path to another
# Efforts: a step of the far policy counts as 1, those of a motion's improvement and of the improved
# policy less. So much effort is made in a second, and more while the far policy still drives.
_FAR, _BACK, _AHEAD = 1.0, 0.33, 0.25
_EFFORT, _AT_FIRST = 50.0, 6.0
_AT_ONCE = 70.0  # effort of a first improvement, for which a robot that begins waits a step
_ANEW = 0.3  # [s] after which a motion begins anew where the robot is
_REST = 33.0  # effort that is saved after a motion that does not come near the path
_BENT = 0.01  # [1/m] between the curvatures of a path that is no line or circle


class FarFromPath:
    """Drives robots far from the path: a wide region, its policy improved, and the one before."""

    def __init__(
        self, settings: Settings, riccati: RiccatiSchedule, before: "FarFromPath | None" = None
    ) -> None:
        """Take the policy from the settings; lead over from the one before."""
        self.region = WideRegion(settings, riccati)
        self._before, self._since = before, 0.0  # [s] from that one on
        if before is not None:
            before._before = None  # only one policy is left at a time
        self._model: MotionModel | None = None
        if self.region.knows_circles and _bends(riccati):
            self._model = MotionModel(settings, riccati)
        self._lookaheads: dict[int, Lookahead] = {}  # of robots far from the path

    def drives_alone(self, share: FloatArray) -> bool:
        """Return whether `far_input` is the input of `blend` where `share` is this (...)."""
        return self._before is None and not anywhere(share != 1.0)

    def blend(self, learned: FloatArray, dt: float, *place: FloatArray) -> FloatArray:
        """Return the modified input, shape (..., 2), learned near the path and this far from it.

        The learned input is within the limits, (..., 2), dt [s] after the last step; the place is
        as in `WideRegion.far_input`.
        """
        here = self._alone(learned, dt, *place)
        self._since += dt
        if self._since >= _CHANGE_TIME:
            self._before = None
        if self._before is None:
            return here
        before = self._before._alone(learned, dt, *place)
        return before + self._since / _CHANGE_TIME * (here - before)

    def _alone(self, learned: FloatArray, dt: float, *place: FloatArray) -> FloatArray:
        """Return the input as `blend`, without the policy before."""
        share = self.region.share(place[1])
        if not anywhere(share > 0.0):
            self._lookaheads.clear()
            return learned
        far, part = self.far_input(dt, *place), np.asarray(share)[..., None]
        return np.asarray((1.0 - part) * learned + part * far)

    def far_input(
        self,
        dt: float,
        arc_length: FloatArray,
        zeta: FloatArray,
        curvature: FloatArray,
        feedforward: FloatArray,
    ) -> FloatArray:
        """Return the far policy's modified input (..., 2), improved where there was time for it."""
        place = arc_length, zeta, curvature, feedforward
        if self._model is None:
            return self.region.far_input(*place)
        if zeta.ndim == 1:
            ahead = self._lookahead(0, self._model)
            u = ahead.input(dt, _state(arc_length, zeta))
            far = self.region.far_input(*place) if u is None else u
            return ahead.eased(dt, far, u is None, feedforward)
        far = self.region.far_input(*place)
        rows, is_far = far.reshape(-1, 2), np.ravel(self.region.share(zeta) > 0.0)
        places, states = np.ravel(arc_length), zeta.reshape(-1, 4)
        steady = feedforward.reshape(-1, 2)
        for index in np.flatnonzero(~is_far).tolist():
            self._lookaheads.pop(index, None)
        for index in np.flatnonzero(is_far).tolist():
            ahead = self._lookahead(index, self._model)
            u = ahead.input(dt, _state(places[index], states[index]))
            chosen = rows[index].copy() if u is None else u
            rows[index] = ahead.eased(dt, chosen, u is None, steady[index])
        return rows.reshape(far.shape)

    def _lookahead(self, index: int, model: MotionModel) -> "Lookahead":
        """Return that of a robot, a new one if it has just come to be far from the path."""
        if index not in self._lookaheads:
            self._lookaheads[index] = Lookahead(self.region, model)
        return self._lookaheads[index]


class Lookahead:
    """Improves the far policy for one robot, a part in each control step."""

    def __init__(self, region: WideRegion, model: MotionModel) -> None:
        self._region, self._model = region, model
        self._due = 0.0  # effort that is to be made
        self._now = _Now()
        self._work = _improving(self._now, region, model)
        self._before: FloatArray | None = None  # the input of the last step
        self._left_over, self._jump, self._was_far = 0.0, np.zeros(2), True

    def input(self, dt: float, state: State) -> FloatArray | None:
        """Return the improved policy's u (2,) at a state dt [s] later, None while there is none."""
        now = self._now
        now.time, now.state = now.time + dt, state
        if now.feedback is None:
            self._due += dt * _AT_FIRST * _EFFORT if dt > 0.0 else _AT_ONCE
        else:
            self._due += dt * _EFFORT
        while self._due > 0.0:
            self._due -= next(self._work)
        if now.feedback is not None and not now.feedback.holds(now.time, state):
            now.feedback = None  # it was pushed, or is not the robot of the model
            self._work = _improving(now, self._region, self._model)
        if now.feedback is None:
            return None
        return now.feedback.input(now.time, state, 0.0)

    def eased(self, dt: float, u: FloatArray, is_far: bool, feedforward: FloatArray) -> FloatArray:
        """Return the input (2,), led over from the last one where the policy has changed."""
        if self._before is not None and is_far != self._was_far and dt > 0.0:
            self._jump, self._left_over = self._before - u, _EASED
        self._was_far, self._left_over = is_far, max(self._left_over - dt, 0.0)
        if self._left_over > 0.0:
            u = u + self._left_over / _EASED * self._jump
        self._before = saturate(u, feedforward, self._model.limits)
        return self._before


class _Now:
    """Where a robot is, and the policy that was found for it."""

    def __init__(self) -> None:
        self.time, self.state = 0.0, (0.0, 0.0, 0.0, 0.0)
        self.feedback: Feedback | None = None


def _improving(now: _Now, region: WideRegion, model: MotionModel) -> Generator[float, None, None]:
    """Find better and better policies for where the robot is; yield the effort of each step."""

    def far(_: float, state: State, __: float) -> FloatArray:
        return region.driven_input(state)

    def improved(feedback: Feedback) -> Policy:
        def policy(time: float, state: State, held: float) -> FloatArray:
            if not feedback.reaches(time):
                return region.driven_input(state)
            return model.limited(feedback.input(time, state, held), state[3])

        return policy

    policy: Policy = far
    effort = _FAR
    while True:
        while not region.reaches(now.state):
            yield _REST
        motion = yield from model.driven(policy, now.time, now.state, effort)
        if motion is None or not region.is_near(motion.end):
            now.feedback, policy, effort = None, far, _FAR
            yield _REST
            continue
        part = 1.0  # of the way to the best inputs, as what is quadratic may hold for a part only
        while now.time - motion.times[0] < _ANEW:
            found = yield from model.improved(motion, part, _BACK)
            other = yield from model.driven(
                *(improved(found), motion.times[0], motion.start, _AHEAD), motion.cost
            )
            if other is not None:
                motion, now.feedback, part = other, found, min(1.0, 2.0 * part)
                policy, effort = improved(found), _AHEAD
            else:
                part *= 0.5


def _state(arc_length: FloatArray, zeta: FloatArray) -> State:
    s, y, theta, _ = numbers(zeta)
    return float(s), float(y), float(theta), float(number(arc_length))


def _bends(riccati: RiccatiSchedule) -> bool:
    """Return whether curvature or speed change along the path."""
    low, high = riccati.path.curvature_range
    if not riccati.path.closed:
        low, high = min(low, 0.0), max(high, 0.0)  # the tangents beyond its ends
    return riccati.profile.varies or high - low > _BENT
