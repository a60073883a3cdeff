"""The peers: closed forms, convergence, limits, and how close the strongest is to the optimum."""

from __future__ import annotations

import json
import math
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from scipy.linalg import solve_continuous_are

from adp_path_follower.core.control import error_dynamics
from adp_path_follower.core.control.cost import RunningCost
from adp_path_follower.core.geometry import advance_pose, pose_in_frame, tracking_error
from adp_path_follower.core.path.library import named_path
from adp_path_follower.core.path.nearest import place_near
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.resources import config_file
from adp_path_follower.study.comparison import steering
from adp_path_follower.study.comparison.controllers import PEERS
from adp_path_follower.study.comparison.error_laws import (
    LapierreSoetanto,
    Lqr,
    TunedLapierreSoetanto,
)
from adp_path_follower.study.comparison.steering import (
    PurePursuit,
    RegulatedPurePursuit,
    Stanley,
    TunedStanley,
)
from folders import DATA, ROOT

try:
    import casadi  # noqa: F401  # only whether it is there
except ImportError:
    HAS_CASADI = False
else:
    HAS_CASADI = True

REFERENCE = json.loads((DATA / "optimum.json").read_text())
UNLIMITED = {
    "min_linear_vel": -math.inf,
    "max_linear_vel": math.inf,
    "max_angular_vel": math.inf,
}
SETTINGS = build(Settings, UNLIMITED)
LIMITED = build(Settings, {})
PATHS = {name: named_path(name) for name in ("line", "circle:0.5", "lissajous")}
STARTS = np.array([[-0.5, 0.25, -math.pi / 6.0], [0.4, -0.6, 0.8], [0.0, 0.7, 0.0]])

needs_casadi = pytest.mark.skipif(not HAS_CASADI, reason="the extra 'optimum' is not installed")
NAMES = [pytest.param(name, marks=needs_casadi if name == "nmpc" else ()) for name in PEERS]


class ClosedLoop:
    """A controller and its robots, moved exactly, with the cost along their true motion."""

    def __init__(self, name, path, starts, settings=SETTINGS, rate=50.0, count_cost=True):
        peer, arc_length = PEERS[name], np.zeros(len(starts))
        self.controller = peer.factory(settings, path, arc_length)
        self.path, self.settings = path, settings
        self.rate = peer.control_rate or rate
        self.pose = pose_in_frame(np.asarray(starts), path.frame(arc_length).pose)
        self.cost = np.zeros(len(starts))
        self.outputs, self.count_cost = [], count_cost
        self.running_cost = RunningCost(settings.cost)

    def run(self, duration):
        """Run for a time [s]."""
        for _ in range(round(duration * self.rate)):
            output = self.controller.step(self.pose, 1.0 / self.rate)
            self.outputs.append(output)
            self._move(output)
        return self

    def _move(self, output):
        if not self.count_cost:
            self.pose = advance_pose(self.pose, *output.command.T, 1.0 / self.rate)
            return
        count = math.ceil(50.0 / self.rate)
        step, place = 1.0 / self.rate / count, output.arc_length
        for _ in range(count):
            first, speed = self._rates(0.0, place, output.command)
            middle, speed = self._rates(0.5 * step, place + 0.5 * step * speed, output.command)
            place = place + step * speed
            last, _ = self._rates(step, place, output.command)
            self.cost += step / 6.0 * (first + 4.0 * middle + last)
            self.pose = advance_pose(self.pose, *output.command.T, step)

    def _rates(self, time, place, command):
        frame = self.path.frame(place)
        error = tracking_error(advance_pose(self.pose, *command.T, time), frame.pose)
        target = self.settings.target
        modified = command - error_dynamics.feedforward(frame.curvature, target.desired_speed)
        speed = error_dynamics.target_speed(error, target, target.desired_speed)
        return self.running_cost(error, modified), speed


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("name", NAMES)
def test_every_peer_comes_to_the_path(name, path):
    duration = 10.0 if name == "nmpc" else 20.0  # it is there sooner, and slow to compute
    loop = ClosedLoop(name, PATHS[path], STARTS, rate=25.0, count_cost=False).run(duration)
    place = place_near(PATHS[path], loop.pose, loop.controller.target.arc_length)
    left = tracking_error(loop.pose, PATHS[path].frame(place).pose)
    # Stanley's front axle is on the circle when the robot is wheelbase^2 kappa / 2 within it.
    inside = 0.5 * 0.3**2 * 0.5 if (name, path) == ("stanley", "circle:0.5") else 0.0
    assert np.abs(left[:, 1]).max() < 0.012 + inside
    if name in ("lapierre_soetanto_tuned", "lqr", "nmpc"):  # they also catch up with the target
        assert np.abs(loop.outputs[-1].error).max() < 0.01
    if name == "nmpc":
        assert loop.controller.failures == 0


@pytest.mark.parametrize("name", NAMES)
def test_a_batch_is_its_robots_one_by_one(name):
    together = ClosedLoop(name, PATHS["lissajous"], STARTS, LIMITED).run(1.0)
    for index, start in enumerate(STARTS):
        alone = ClosedLoop(name, PATHS["lissajous"], start[None], LIMITED).run(1.0)
        assert alone.pose[0] == pytest.approx(together.pose[index], abs=1e-9)
        assert alone.cost[0] == pytest.approx(together.cost[index], rel=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_a_run_repeats_itself(name):
    first, second = (
        ClosedLoop(name, PATHS["lissajous"], STARTS, count_cost=False).run(1.0) for _ in range(2)
    )
    assert np.array_equal(first.pose, second.pose)


@pytest.mark.parametrize("name", NAMES)
def test_output_agrees_with_itself(name):
    for output in ClosedLoop(name, PATHS["lissajous"], STARTS, LIMITED).run(0.5).outputs:
        steady = error_dynamics.feedforward(output.curvature, LIMITED.target.desired_speed)
        assert output.modified_input == pytest.approx(output.command - steady, abs=1e-12)
        frame = PATHS["lissajous"].frame(output.arc_length)
        assert output.target_pose == pytest.approx(frame.pose)
        assert output.command.shape == (3, 2)


finite = st.floats(-1e9, 1e9) | st.floats(-3.0, 3.0)


@pytest.mark.parametrize("name", NAMES)
@hypothesis_settings(max_examples=25)
@given(
    settings=st.sampled_from([LIMITED, SETTINGS]),
    path=st.sampled_from(sorted(PATHS)),
    poses=st.lists(st.tuples(finite, finite, finite), min_size=1, max_size=3),
)
def test_any_finite_pose_gives_a_command_within_the_limits(name, settings, path, poses):
    controller = PEERS[name].factory(settings, PATHS[path], np.zeros(1))
    for pose in poses:
        command = controller.step(np.array([pose]), 0.02).command
        assert np.isfinite(command).all()
        assert (command >= settings.limits.lower).all()
        assert (command <= settings.limits.upper).all()


def test_pursuit_follows_the_arc_through_the_point_ahead():
    radius, angle = 2.5, 0.4
    point = np.array([radius * math.sin(angle), radius * (1.0 - math.cos(angle))])
    assert steering.pursuit_curvature(point) == pytest.approx(1.0 / radius)
    assert steering.pursuit_curvature(-point * [-1.0, 1.0]) == pytest.approx(-1.0 / radius)
    assert steering.pursuit_curvature(np.zeros(2)) == 0.0


def test_pure_pursuit_steers_by_twice_the_offset_over_the_distance_squared():
    # On a line, 0.3 m to its left: the point 1 m away lies 0.3 m to the right.
    output = PurePursuit(SETTINGS, PATHS["line"], np.array([5.0])).step(
        np.array([[5.0, 0.3, 0.0]]), 0.0
    )
    assert output.command[0] == pytest.approx([0.5, 0.5 * 2.0 * -0.3 / 1.0**2], abs=1e-4)


def test_pure_pursuit_aims_at_the_nearest_place_from_far_away():
    output = PurePursuit(SETTINGS, PATHS["line"], np.array([5.0])).step(
        np.array([[5.0, 2.0, 0.0]]), 0.0
    )
    assert output.command[0] == pytest.approx([0.5, 0.5 * 2.0 * -2.0 / 2.0**2], abs=1e-6)


def test_search_stays_on_its_branch_of_a_crossing():
    path = PATHS["lissajous"]
    crossing, other = 0.0, 0.5 * path.length
    assert path.frame(crossing).pose[:2] == pytest.approx(path.frame(other).pose[:2], abs=1e-9)
    place = np.array([crossing - 0.5, other - 0.5])
    for step in np.arange(-0.5, 0.5, 0.01):
        poses = path.frame(np.array([crossing, other]) + step).pose
        place = place_near(path, poses, place)
        assert place == pytest.approx([crossing + step, other + step], abs=1e-6)


@pytest.mark.parametrize(
    ("curvature", "speed"),
    [(0.0, 0.5), (1.0 / 0.9, 0.5), (-1.0 / 0.6, 0.5 * 0.6 / 0.9), (10.0, 0.25)],
)
def test_regulated_pure_pursuit_slows_down_in_turns(curvature, speed):
    controller = RegulatedPurePursuit(SETTINGS, PATHS["line"], np.zeros(1))
    assert controller.regulated_speed(np.array(curvature)) == pytest.approx(speed)


def test_regulated_pure_pursuit_looks_ahead_by_speed():
    controller = RegulatedPurePursuit(SETTINGS, PATHS["line"], np.zeros(1))
    controller.use_velocity_scaled_lookahead_dist = True
    assert controller.lookahead(np.array([0.0, 0.4, -0.5, 2.0])) == pytest.approx(
        [0.3, 0.6, 0.75, 0.9]
    )
    fixed = RegulatedPurePursuit(SETTINGS, PATHS["line"], np.zeros(1))
    assert fixed.lookahead(np.array([0.0, 2.0])) == pytest.approx([0.6, 0.6])


def test_regulated_pure_pursuit_turns_in_place_with_bounded_acceleration():
    controller = RegulatedPurePursuit(SETTINGS, PATHS["line"], np.array([5.0]))
    pose = np.array([[5.0, 0.0, -1.5]])
    turns = [controller.step(pose, dt).command[0].tolist() for dt in (0.0, *[0.1] * 6)]
    rising = [0.16, 0.48, 0.8, 1.12, 1.44, 1.76, 1.8]  # the first one by Nav2's 0.05 s
    assert turns == [pytest.approx([0.0, turn]) for turn in rising]


def test_stanley_steers_by_its_law():
    speed, pose = SETTINGS.target.desired_speed, np.array([[5.0, 0.1, -0.2]])
    front = 0.1 + Stanley.wheelbase * math.sin(-0.2)
    steering = 0.2 - math.atan(Stanley.position_gain * front / speed)
    expected = speed * math.tan(steering) / Stanley.wheelbase
    output = Stanley(SETTINGS, PATHS["line"], np.array([5.0])).step(pose, 0.0)
    assert output.command[0] == pytest.approx([speed, expected])


def test_stanley_limits_its_steering():
    output = Stanley(SETTINGS, PATHS["line"], np.array([5.0])).step(np.array([[5.0, 9.0, 1.0]]), 0)
    assert output.command[0, 1] == pytest.approx(-0.5 * math.tan(math.radians(35.0)) / 0.3)


def test_tuned_stanley_keeps_a_robot_on_a_circle():
    path = PATHS["circle:0.5"]
    controller = TunedStanley(SETTINGS, path, np.array([1.0]))
    output = controller.step(path.frame(np.array([1.0])).pose, 0.0)
    assert output.modified_input[0] == pytest.approx([0.0, 0.0], abs=1e-9)


def lyapunov(law, error):
    """Return V of errors (..., 3), shape (...)."""
    s, y, theta = np.moveaxis(error, -1, 0)
    miss = theta + law.approach_angle * np.tanh(law.approach_gain * y)
    return 0.5 * (s * s + y * y) + 0.5 * miss * miss / law.coupling


@pytest.mark.parametrize("law", [LapierreSoetanto, TunedLapierreSoetanto])
def test_lapierre_soetanto_lets_its_lyapunov_function_decrease(law):
    rng, path = np.random.default_rng(5), PATHS["circle:0.5"]
    # v = v_des - k s takes energy out of s while v > 0 and |theta| < pi / 2.
    starts = rng.uniform(-1.0, 1.0, (200, 3)) * [0.45, 1.0, 1.4]
    pose = pose_in_frame(starts, path.frame(np.zeros(200)).pose)
    controller = law(SETTINGS, path, np.zeros(200))
    output = controller.step(pose, 0.0)
    step = 1e-5
    moved = advance_pose(pose, *output.command.T, step)
    after = controller.step(moved, step).error
    rate = (lyapunov(law, after) - lyapunov(law, output.error)) / step
    assert (rate < 0.0).all()
    if law is LapierreSoetanto:
        s, y, theta = output.error.T
        approach = -law.approach_angle * np.tanh(law.approach_gain * y)
        expected = (
            -0.1 * s**2
            + y * 0.5 * np.sin(approach)
            - law.heading_gain * (theta - approach) ** 2 / law.coupling
        )
        assert rate == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("curvature", [0.5, -1.0])
def test_lqr_has_the_gain_of_the_riccati_equation(curvature):
    settings = build(
        Settings, {**UNLIMITED, "state_cost": (1.0, 3.0, 0.5), "input_cost": (2.0, 0.5)}
    )
    path = named_path(f"circle:{curvature}")
    system = np.array([[-0.1, 0.5 * curvature, 0], [-0.5 * curvature, 0, 0.5], [0, 0, 0]])
    system[2, 0] = -0.1 * curvature
    inputs, cost = np.array([[1.0, 0], [0, 0], [0, 1.0]]), np.diag([2.0, 0.5])
    solution = solve_continuous_are(system, inputs, np.diag([1.0, 3.0, 0.5]), cost)
    gain = np.linalg.solve(cost, inputs.T @ solution)
    controller = Lqr(settings, path, np.zeros(3))
    pose = pose_in_frame(1e-4 * np.eye(3), path.frame(np.zeros(3)).pose)
    found = controller.step(pose, 0.0).modified_input / 1e-4
    assert found == pytest.approx(-gain.T, abs=1e-3)


@needs_casadi
def test_nmpc_comes_close_to_the_optimum():
    settings = load_settings(Settings, "path_follower", config_file("paper.yaml"))
    start = np.array([REFERENCE["figure_eight"]["start"]])
    loop = ClosedLoop("nmpc", PATHS["lissajous"], start, settings).run(30.0)
    assert loop.controller.failures == 0
    assert 0.9999 < loop.cost[0] / REFERENCE["figure_eight"]["cost"] < 1.002


@needs_casadi
def test_nmpc_is_near_optimal_from_many_starts():
    reference = REFERENCE["forty_starts"]
    loop = ClosedLoop("nmpc", PATHS["lissajous"], reference["e0"][:10]).run(20.0)
    ratio = loop.cost / reference["lissajous"]["costs"][:10]
    assert ratio.min() > 0.999
    assert ratio.max() < 1.003


@needs_casadi
def test_nmpc_sees_the_bend_ahead():
    """On the path before a bend there is nothing to win: it must not turn in early."""
    path = PATHS["lissajous"]
    controller = PEERS["nmpc"].factory(SETTINGS, path, np.array([16.0]))
    output = controller.step(path.frame(np.array([16.0])).pose, 0.0)
    # The command is held for a step, so it is the feedforward of the step's middle.
    curvature = path.curvature(np.array([16.025]))
    middle = error_dynamics.feedforward(curvature, SETTINGS.target.desired_speed)
    assert output.command == pytest.approx(middle, abs=5e-3)


@needs_casadi
def test_nmpc_keeps_its_shifted_plan_when_the_solver_fails(monkeypatch):
    loop = ClosedLoop("nmpc", PATHS["line"], STARTS).run(1.0)
    controller = loop.controller
    expected = np.array([plan.after(0.05).command[0] for plan in controller._plans])
    monkeypatch.setattr(controller._solver, "solve", lambda *_: None)
    output = controller.step(loop.pose, 0.05)
    assert controller.failures == len(STARTS)
    assert output.command == pytest.approx(expected)


@needs_casadi
def test_nmpc_finds_a_solver_without_a_compiler(monkeypatch):
    from adp_path_follower.study.comparison import nmpc

    monkeypatch.setenv("PATH", "")
    settings = build(Settings, {**UNLIMITED, "target_gain": 0.4})
    solver = nmpc.HorizonSolver(settings)
    assert solver.name.endswith("not compiled")


def test_without_casadi_only_nmpc_is_missing(tmp_path):
    (tmp_path / "casadi.py").write_text("raise ImportError('not here')\n")
    script = (
        "import numpy as np\n"
        "from adp_path_follower.study.comparison.controllers import PEERS\n"
        "from adp_path_follower.core.errors import AdpError\n"
        "from adp_path_follower.core.path.library import named_path\n"
        "from adp_path_follower.core.settings.schema import build\n"
        "from adp_path_follower.core.settings.groups import Settings\n"
        "for name, peer in PEERS.items():\n"
        "    try:\n"
        "        peer.factory(build(Settings, {}), named_path('line'), np.zeros(1))\n"
        "    except AdpError as error:\n"
        "        print(name, error)\n"
    )
    root = ROOT
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            f"import sys; sys.path[:0] = [{str(tmp_path)!r}, {str(root)!r}]\n" + script,
        ],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [
        "nmpc the peer 'nmpc' needs CasADi: pip install 'adp_path_follower[optimum]'"
    ]


@pytest.mark.parametrize("name", NAMES)
def test_every_peer_keeps_to_the_speed_along_the_path_and_to_limits_of_acceleration(name):
    values = {"max_linear_accel": 0.8, "max_linear_decel": 0.6, "max_angular_accel": 3.0}
    settings = build(Settings, {**values, "max_lateral_accel": 0.1})
    path, place = PATHS["lissajous"], np.full(3, 16.0)
    controller = PEERS[name].factory(settings, path, place)
    period = 1.0 / (PEERS[name].control_rate or 50.0)
    pose = pose_in_frame(STARTS, path.frame(place).pose)
    commands = [np.zeros((3, 2))]
    for _ in range(round(4.0 / period)):
        output = controller.step(pose, period)
        commands.append(output.command)
        feedforward = output.command - output.modified_input
        np.testing.assert_allclose(feedforward[:, 1], feedforward[:, 0] * output.curvature)
        if len(commands) == 2:  # at rest
            np.testing.assert_allclose(feedforward[:, 0], 0.05)
        pose = advance_pose(pose, *output.command.T, period)
    changes = np.diff(commands, axis=0)[1:] / period  # the first may be that of a usual period
    assert (np.abs(changes[..., 1]) < 3.0 + 1e-9).all()
    assert changes[..., 0].max() < 0.8 + 1e-9
    assert changes[..., 0].min() > -0.6 - 1e-9


def test_peers_are_named_and_described():
    assert all(peer.description for peer in PEERS.values())
    assert {name for name, peer in PEERS.items() if peer.control_rate} == {"nmpc"}
