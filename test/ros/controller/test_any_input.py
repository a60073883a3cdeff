"""Any odometry, path and parameters that can be built, through the callbacks of the real node.

No exception, and every command that is published is finite and within the limits of velocity and
acceleration.
"""

from __future__ import annotations

import itertools
import math
import time

import numpy as np
import pytest
import rclpy
from any_messages import PERIOD, odometry, paths
from hypothesis import example, given, settings
from hypothesis import strategies as st
from nav_msgs.msg import Odometry
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions

from adp_path_follower.core.path.library import named_path
from adp_path_follower.core.safety import supervisor
from adp_path_follower.core.safety.odometry_check import OdometryCheck
from adp_path_follower.core.safety.supervisor import State
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import flatten, setting_fields
from adp_path_follower.ros.controller.node import PathFollowerNode
from adp_path_follower.ros.runtime.conversions import odometry_message, poses_message
from adp_path_follower.study.demo import own_domain

FRAMES = ("odom", "base_link")
# A small learner, as it is not what is tried here; and no clock, so that any stamp may come.
GIVEN = {
    "basis_degree": 4,
    "sample_count": 64,
    "samples_per_step": 64,
    "control_trigger": "odometry",
    "use_sim_time": True,
    "odom_timeout": 60.0,  # a loaded machine is no fault
}
LINE = poses_message(named_path("line").points(0.1), "odom", 0)


class Spied(PathFollowerNode):
    """The controller node, whose callbacks the test calls and whose commands are looked at."""

    told = None

    def begin(self, **parameters):
        """Forget what was, and begin a run with these parameters."""
        values = {**flatten(self.settings), **parameters}
        self._forget_run()
        self._supervisor.resume()
        odometry, path, commands = self._parts.odometry, self._parts.path, self._parts.commands
        odometry.measurement, odometry._check = None, OdometryCheck()
        path.stop()
        self._parts.frame.odometry_in(*FRAMES)
        self._supervisor.active = True
        self.commands, self.told = [], None
        commands.send, commands.stop = self.sent, self.stopped
        results = self.change({name: values[name] for name in parameters})
        assert all(result.successful for result in results), results

    def change(self, values):
        """Set some parameters at once, as the service does; return the results."""
        parameters = [
            Parameter(name, value=list(value) if isinstance(value, tuple) else value)
            for name, value in values.items()
        ]
        return [self.set_parameters_atomically(parameters)] if parameters else []

    def stopped(self):
        """Take the robot for one at rest, as it is told to stop."""
        self.told = None
        type(self._parts.commands).stop(self._parts.commands)

    def sent(self, command, time):
        """Look at a command that is to be published, and at the one before."""
        assert np.isfinite(command).all(), command
        limits, motion = self.settings.limits, self.settings.motion
        before, period = np.zeros(2), 1.0 / self.settings.controller.controller_frequency
        if self.told is not None:
            before, elapsed = self.told[0], 1e-9 * (time - self.told[1])
            period = min(elapsed, 0.1) if elapsed > 1e-6 else period
        self.told = (command, time)
        self.commands.append(command)
        # Beyond the velocity limits only on the way back to them, after these were changed.
        beyond = [
            np.maximum(limits.lower - item, 0.0) + np.maximum(item - limits.upper, 0.0)
            for item in (before, command)
        ]
        assert (beyond[1] <= beyond[0] + 1e-9).all(), (before, command)
        (v0, w0), (v1, w1) = before, command
        assert abs(w1 - w0) <= motion.max_angular_accel * period * (1 + 1e-9) + 1e-9
        # Faster in either direction is to accelerate; slower, down to rest, to decelerate.
        faster = max(abs(v1) - abs(v0), 0.0) if v0 * v1 >= 0.0 else abs(v1)
        slower = max(abs(v0) - abs(v1), 0.0) if v0 * v1 >= 0.0 else abs(v0)
        assert faster <= motion.max_linear_accel * period * (1 + 1e-9) + 1e-9, (before, command)
        assert slower <= motion.max_linear_decel * period * (1 + 1e-9) + 1e-9, (before, command)

    def take(self, message):
        """Take an odometry message or a path."""
        if isinstance(message, Odometry):
            self.take_bytes(serialize_message(message))
        else:
            now = {"source_timestamp": time.monotonic_ns()}
            self._parts.path._receive(serialize_message(message), now)
        self._take_path()
        self._watch()

    def take_bytes(self, raw):
        """Take what may be an odometry message."""
        self._parts.odometry._receive(raw)

    def _take_path(self):
        """Take what the other thread has made of a path."""
        intake = self._parts.path._intake
        while intake._latest is not None:
            intake._latest.exception()  # waits
            self._parts.path._take()

    @property
    def state(self):
        """Return the supervisor's state."""
        return self._update_status().state


@pytest.fixture(scope="module")
def node():
    supervisor._SETTLED = 0.0  # no time passes here while messages come
    arguments = ["test", "--ros-args", "--log-level", "fatal"]
    for name, value in GIVEN.items():
        arguments += ["-p", f"{name}:={str(value).lower()}"]
    with own_domain() as domain:
        rclpy.init(args=arguments, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
        found = Spied()
        yield found
        found.destroy_node()
        rclpy.try_shutdown()


def good_odometry(step, pose=(0.0, 0.1, 0.0)):
    return odometry_message(step * PERIOD, np.array(pose), np.array([0.5, 0.0]), FRAMES)


def is_good_again(node, first_step, pose=(0.0, 0.1, 0.0)):
    """Return whether the node follows when sound odometry comes for a while."""
    for step in range(first_step, first_step + 5):
        node.take(good_odometry(step, pose))
    assert node.state is State.FOLLOWING, node.status  # which says why not
    return True


ACCELERATIONS = {"max_linear_accel": 0.5, "max_linear_decel": 1.0, "max_angular_accel": 2.0}


@settings(max_examples=120)
@given(
    messages=st.lists(st.one_of(odometry(), odometry(), paths()), max_size=6),
    tolerance=st.sampled_from([0.5, math.inf]),
    first=st.booleans(),
    limited=st.booleans(),
)
def test_any_messages(node, messages, tolerance, first, limited):
    accelerations = ACCELERATIONS if limited else dict.fromkeys(ACCELERATIONS, math.inf)
    node.begin(odom_jump_tolerance=tolerance, **accelerations)
    node.take(LINE)
    if not first:
        for step in range(3):
            node.take(good_odometry(step))
    for message in messages:
        node.take(message)


@settings(max_examples=60)
@given(cut=st.integers(0, 750), place=st.integers(0, 749), value=st.integers(0, 255))
@example(cut=0, place=0, value=0)
def test_bytes_that_are_no_odometry_stop_the_robot(node, cut, place, value):
    """Bytes that are cut off are told; one that is wrong may make numbers, whichever."""
    node.begin()
    node.take(LINE)
    for step in range(3):
        node.take(good_odometry(step))
    raw = bytearray(serialize_message(good_odometry(3)))
    node.take_bytes(bytes(raw[: cut % len(raw)]))
    assert "odometry cannot be read" in node.status.cause
    assert not node.commands[-1].any()
    assert is_good_again(node, 3)
    raw[place % len(raw)] = value
    node.take_bytes(bytes(raw))
    node._watch()


far = st.sampled_from([sign * 10.0**power for sign in (1, -1) for power in range(9)])


@settings(max_examples=60)
@given(
    place=st.tuples(far, far | st.just(0.0), st.floats(-4.0, 4.0)),
    tolerance=st.sampled_from([0.5, math.inf]),
    before=st.integers(1, 3),
)
@example(place=(-1e6, 0.0, 0.0), tolerance=math.inf, before=3)
@example(place=(1e8, 0.0, 0.0), tolerance=math.inf, before=3)
def test_one_message_from_another_place_does_not_send_the_target_away(
    node, place, tolerance, before
):
    node.begin(odom_jump_tolerance=tolerance)
    node.take(LINE)
    for step in range(before):
        node.take(good_odometry(step))
    node.take(good_odometry(before, place))
    assert is_good_again(node, before + 1)
    assert -0.5 < float(node.driver.follower.arc_length) < 0.5
    assert node.commands[-1].any()


@pytest.mark.parametrize("tolerance", [0.5, math.inf])
@pytest.mark.parametrize("distance", [1e3, 1e6, 1e8])
def test_a_first_pose_that_is_absurd(node, tolerance, distance):
    """The target begins at the place nearest to it, and stays about there."""
    node.begin(odom_jump_tolerance=tolerance)
    node.take(LINE)
    node.take(good_odometry(0, (-distance, 0.0, 0.0)))
    for step in range(1, 5):
        node.take(good_odometry(step))
    assert node.state is State.FOLLOWING
    assert -0.5 < float(node.driver.follower.arc_length) < 0.5


def test_a_path_that_was_refused_for_the_frame_of_the_odometry_is_taken_in_the_right_one(node):
    node.begin()
    wrong = odometry_message(0, np.zeros(3), np.array([0.5, 0.0]), ("map", "base_link"))
    node.take(wrong)
    node.take(LINE)
    assert "map" in node.parts.path.problem
    assert is_good_again(node, 1)
    assert not node.parts.path.problem


def test_what_is_too_far_or_too_fast_is_told(node):
    for broken in ({"pose": (1e9, 0.0, 0.0)}, {"pose": (0.0, -1e300, 0.0)}):
        node.begin()
        node.take(LINE)
        node.take(good_odometry(0, **broken))
        assert "check its units" in node._update_status().cause
        assert not any(command.any() for command in node.commands)
        assert is_good_again(node, 1)


# --- parameters ---------------------------------------------------------------------------------

FIELDS = setting_fields(Settings)
DYNAMIC = [field for field in FIELDS if not field.spec.read_only]


START = {field.name: GIVEN.get(field.name, field.default) for field in DYNAMIC}


def within(field):
    """Return values of a setting's type in its range, with its ends and far beyond in between."""
    spec = field.spec
    kind = field.item_kind or field.kind
    if spec.choices:
        items = st.sampled_from(spec.choices)
    elif kind is bool:
        items = st.booleans()
    elif kind is int:
        items = st.integers(int(spec.low), min(int(spec.high), 200))
    elif kind is float:
        ends = [value for value in (spec.low, spec.high) if not math.isnan(value)]
        usual = st.floats(max(spec.low, -2.0), min(spec.high, 2.0))
        items = st.one_of(usual, st.sampled_from(ends), st.floats(spec.low, spec.high))
    else:
        items = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=8)
    if field.item_kind is None:
        return items
    lengths = spec.lengths or (6,)
    return st.sampled_from(lengths).flatmap(lambda n: st.lists(items, min_size=n, max_size=n))


changes = st.lists(
    st.sampled_from(DYNAMIC), max_size=4, unique_by=lambda field: field.name
).flatmap(lambda fields: st.fixed_dictionaries({field.name: within(field) for field in fields}))

junk = st.one_of(
    st.booleans(),
    st.integers(-(2**63), 2**63 - 1),
    st.floats(),
    st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=5),
    st.lists(st.floats(), max_size=9),
    st.lists(st.integers(-9, 9), max_size=9),
    st.lists(st.booleans(), max_size=3),
)


def present(node):
    """Return the node's parameters as ROS has them."""
    return {field.name: node.get_parameter(field.name).value for field in FIELDS}


def as_ros_has(settings_now):
    return {
        name: list(v) if isinstance(v, tuple) else v for name, v in flatten(settings_now).items()
    }


def lists(values):
    return {name: v.tolist() if hasattr(v, "tolist") else v for name, v in values.items()}


@settings(max_examples=80)
@given(
    sets=st.lists(changes, max_size=3),
    bad=st.dictionaries(
        st.sampled_from([field.name for field in FIELDS]), junk, min_size=1, max_size=3
    ),
)
def test_any_parameters_while_driving(node, sets, bad):
    """A set is taken as a whole or refused as a whole; ROS and the controller agree on it."""
    node.begin(**START)
    node.take(LINE)
    step = itertools.count()
    node.take(good_odometry(next(step)))
    for values in (*sets, bad):
        before = node.settings
        (result,) = node.change(values) or [None]
        if result is not None and not result.successful:
            assert result.reason
            assert "\n" not in result.reason
            assert node.settings == before
        assert lists(present(node)) == as_ros_has(node.settings)
        for _ in range(2):
            node.take(good_odometry(next(step)))


def test_a_change_that_another_callback_refuses_changes_nothing(node):
    node.begin(**START)
    node.take(LINE)
    node.take(good_odometry(0))
    before = node.settings
    (result,) = node.change({"desired_speed": 0.3, "use_sim_time": "yes"})
    assert not result.successful
    assert node.settings == before
    assert node.get_parameter("desired_speed").value == before.target.desired_speed


def test_what_only_fits_together_is_set_together(node):
    """One by one, a state in between may be refused: the service for sets is for that."""
    node.begin(**START)
    assert not node.change({"knot_spacing": 3.0})[0].successful
    assert node.change({"knot_spacing": 3.0, "preview_distance": 8.0})[0].successful
    assert node.change({"knot_spacing": 0.2, "preview_distance": 2.0})[0].successful


def test_integers_for_numbers_are_numbers(node):
    node.begin(**START)
    assert node.change({"max_linear_vel": 2, "state_cost": [1, 2, 3]})[0].successful
    assert node.get_parameter("max_linear_vel").type_ is Parameter.Type.DOUBLE
    assert node.get_parameter("state_cost").type_ is Parameter.Type.DOUBLE_ARRAY
    assert node.change({"max_cross_track_error": "inf", "target_gain": "1e-06"})[0].successful
    assert node.get_parameter("target_gain").value == 1e-6
    assert not node.change({"max_cross_track_error": "nan"})[0].successful
    assert not node.change({"desired_speed": "fast"})[0].successful
    described = node.describe_parameter("desired_speed")
    assert described.type == Parameter.Type.DOUBLE.value
