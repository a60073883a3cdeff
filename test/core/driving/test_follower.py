"""The follower: one step against the formulas, many steps against integration."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy.integrate import solve_ivp, trapezoid

from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.geometry import advance_pose, pose_in_frame
from adp_path_follower.core.learning.weights import Weights
from adp_path_follower.core.path.library import circle, lissajous, named_path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build, update

PATHS = {"figure eight": lissajous(), "circle": circle(0.5), "line": named_path("line")}
every_path = st.sampled_from(sorted(PATHS))
LIMITED = {"min_linear_vel": 0.0, "max_linear_vel": 1.0, "max_angular_vel": 1.5}
seeds = st.integers(0, 2**32 - 1)
errors = st.tuples(
    st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.floats(-math.pi + 1e-6, math.pi - 1e-6)
).map(np.array)
weights = npst.arrays(float, 9, elements=st.floats(-2.0, 2.0))

OUTPUTS = (
    *("command", "modified_input", "error", "target_pose", "arc_length", "curvature"),
    *("running_cost", "bellman_error", "excitation"),
)


def contents(output):
    """Return every array of an output by name."""
    return {
        **{name: np.asarray(getattr(output, name)) for name in OUTPUTS},
        "critic": output.weights.critic,
        "actor": output.weights.actor,
        "sampled error": output.sampled.error,
    }


def noisy_poses(path, seed, count, batch=()):
    """Return poses that wander about a target which moves at 0.5 m/s, and the periods."""
    random = np.random.default_rng(seed)
    periods = random.uniform(0.005, 0.05, count)
    places = 0.5 * np.cumsum(periods)
    frames = path.frame(np.broadcast_to(places[:, None], (count, max(1, math.prod(batch))))).pose
    error = random.uniform(-0.4, 0.4, frames.shape)
    return pose_in_frame(error, frames).reshape(count, *batch, 3), periods


# --- one step -----------------------------------------------------------------------------------


@settings(max_examples=80)
@given(
    name=every_path,
    place=st.floats(0.0, 1.0),
    error=errors,
    critic=weights,
    actor=weights,
    limited=st.booleans(),
)
def test_a_step_gives_what_the_formulas_give(
    printed, paper, name, place, error, critic, actor, limited
):
    values = {**paper, **(LIMITED if limited else {}), "input_cost": (2.0, 0.5)}
    path = PATHS[name]
    s_p = place * path.length
    follower = PathFollower(build(Settings, values), path, s_p, Weights(critic, actor))
    frame = path.frame(s_p)
    output = follower.step(pose_in_frame(error, frame.pose), 0.01)

    kappa = float(frame.curvature)
    zeta = (*error, math.tanh(printed.k2 * s_p))
    state_cost, input_cost = printed.costs(values)
    limits = (0.0, 1.0, 1.5) if limited else (-math.inf, math.inf, math.inf)
    applied = printed.policy(zeta, kappa, actor, input_cost, limits)
    delta, omega, p = printed.bellman_error(zeta, kappa, applied, critic, state_cost, input_cost)
    np.testing.assert_allclose(output.error, error, atol=1e-9)
    np.testing.assert_allclose(output.target_pose, frame.pose, atol=1e-12)
    assert output.arc_length == s_p
    assert output.curvature == pytest.approx(kappa, abs=1e-12)
    np.testing.assert_allclose(output.modified_input, applied, atol=1e-9)
    steady = np.array([printed.v_des, kappa * printed.v_des])
    np.testing.assert_allclose(output.command, applied + steady, atol=1e-9)
    cost = error @ state_cost @ error + applied @ input_cost @ applied
    assert output.running_cost == pytest.approx(cost, rel=1e-9, abs=1e-9)
    assert output.bellman_error == pytest.approx(delta, rel=1e-7, abs=1e-7)
    np.testing.assert_allclose(output.measured.regressor[0], omega, rtol=1e-7, atol=1e-7)
    assert output.measured.normalization[0] == pytest.approx(p, rel=1e-7)
    deltas = [delta for delta, _, _ in printed.sampled_errors(values, path, critic, actor)]
    np.testing.assert_allclose(output.sampled.error, deltas, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_a_short_step_learns_at_the_rates_of_the_printed_laws(printed, paper, figure_eight, seed):
    random = np.random.default_rng(seed)
    critic, actor = random.normal(size=9), random.normal(size=9)
    follower = PathFollower(build(Settings, paper), figure_eight, 20.0, Weights(critic, actor))
    error = random.uniform(-0.8, 0.8, 3)
    pose = pose_in_frame(error, figure_eight.frame(20.0).pose)
    follower.step(pose, 0.0)
    dt = 1e-6
    output = follower.step(pose, dt)
    state_cost, input_cost = printed.costs(paper)
    zeta = (*output.error, math.tanh(printed.k2 * float(output.arc_length)))
    kappa = float(output.curvature)
    applied = printed.policy(zeta, kappa, actor, input_cost)
    measured = printed.bellman_error(zeta, kappa, applied, critic, state_cost, input_cost)
    sampled = printed.sampled_errors(paper, figure_eight, critic, actor)
    expected = printed.weight_rates(critic, actor, measured, sampled)
    found = (follower.weights.critic - critic) / dt, (follower.weights.actor - actor) / dt
    np.testing.assert_allclose(found[0], expected[0], rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(found[1], expected[1], rtol=1e-3, atol=1e-3)


@settings(max_examples=120)
@given(
    name=every_path,
    place=st.floats(-1.0, 2.0),
    pose=st.tuples(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.floats(-100.0, 100.0)),
    lowest=st.floats(-2.0, 0.0),
    highest=st.floats(0.01, 3.0),
    turn=st.floats(0.01, 3.0),
    dt=st.floats(0.0, 1.0),
)
def test_commands_are_finite_and_within_the_limits(
    paper, name, place, pose, lowest, highest, turn, dt
):
    limits = {"min_linear_vel": lowest, "max_linear_vel": highest, "max_angular_vel": turn}
    path = PATHS[name]
    follower = PathFollower(build(Settings, {**paper, **limits}), path, place * path.length)
    for _ in range(3):
        v, w = follower.step(np.array(pose), dt).command
        assert lowest - 1e-12 <= v <= highest + 1e-12
        assert -turn - 1e-12 <= w <= turn + 1e-12


# --- many steps ---------------------------------------------------------------------------------


@settings(max_examples=10)
@given(seed=seeds, name=every_path)
def test_the_same_inputs_give_the_same_bits(paper, seed, name):
    poses, periods = noisy_poses(PATHS[name], seed, 30)
    runs = []
    for _ in range(2):
        follower = PathFollower(build(Settings, {**paper, **LIMITED}), PATHS[name])
        runs.append(
            [
                contents(follower.step(pose, dt))
                for pose, dt in zip(poses, periods.tolist(), strict=True)
            ]
        )
    for first, second in zip(*runs, strict=True):
        for key, value in first.items():
            assert value.tobytes() == second[key].tobytes()


@settings(max_examples=10)
@given(seed=seeds, limited=st.booleans())
def test_a_batch_of_robots_is_driven_as_single_ones_are(paper, figure_eight, seed, limited):
    tuning = build(Settings, {**paper, **(LIMITED if limited else {})})
    poses, periods = noisy_poses(figure_eight, seed, 20, (5,))
    starts = np.linspace(0.0, 2.0, 5)
    together = PathFollower(tuning, figure_eight, starts)
    singles = [PathFollower(tuning, figure_eight, start) for start in starts.tolist()]
    for pose, dt in zip(poses, periods.tolist(), strict=True):
        batch = contents(together.step(pose, dt))
        for index, follower in enumerate(singles):
            for key, value in contents(follower.step(pose[index], dt)).items():
                # Weights that all robots have in common have no axis of the batch.
                together_value = (
                    batch[key] if batch[key].shape == value.shape else batch[key][index]
                )
                np.testing.assert_allclose(together_value, value, rtol=1e-10, atol=1e-12)
    for index, follower in enumerate(singles):
        assert together.cost[index] == pytest.approx(float(follower.cost), abs=1e-12)


def robot_at(time):
    """Return a pose that moves smoothly, off the path and with a varying heading."""
    return np.array(
        [
            2.0 * math.sin(0.25 * time) + 0.2,
            2.0 * (1.0 - math.cos(0.25 * time)) - 0.1,
            0.25 * time + 0.3 * math.sin(time),
        ]
    )


extreme = st.one_of(st.floats(), st.sampled_from([math.inf, -math.inf, math.nan, 1e300, 1e160]))


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # numpy's, of what is infinite
@settings(max_examples=60)
@given(
    poses=st.lists(st.tuples(extreme, extreme, extreme), min_size=1, max_size=3),
    open_path=st.booleans(),
    scheduling=st.sampled_from(["arc_length", "path_state"]),
    seed=seeds,
)
def test_any_pose_has_an_answer_which_is_that_of_a_batch(poses, open_path, scheduling, seed):
    """One robot is computed with Python's numbers, which raise where numpy's do not."""
    path = PATHS["line" if open_path else "circle"]
    settings = build(Settings, {"scheduling": scheduling, "learning": False, **LIMITED})
    one, batch = PathFollower(settings, path), PathFollower(settings, path, np.zeros(1))
    sound, _ = noisy_poses(path, seed, 3)
    for pose in (sound[0], *np.array(poses), sound[1]):
        alone, among = one.step(pose, 0.01), batch.step(pose[None], 0.01)
        for name in ("command", "error", "arc_length", "running_cost", "bellman_error", "doubt"):
            expected = np.asarray(getattr(among, name))[0]
            np.testing.assert_allclose(getattr(alone, name), expected, rtol=1e-6, atol=1e-9)


def test_the_target_moves_by_its_law_to_second_order(paper):
    kappa, duration, v_des, k1 = 0.5, 8.0, 0.5, 0.1

    def target_rate(time, state):
        x, y, theta = robot_at(time)
        heading = kappa * state[0]
        dx = x - math.sin(heading) / kappa
        dy = y - (1.0 - math.cos(heading)) / kappa
        along = math.cos(heading) * dx + math.sin(heading) * dy
        return [v_des * math.cos(theta - heading) + k1 * along]

    exact = solve_ivp(target_rate, (0.0, duration), [0.0], rtol=1e-11, atol=1e-12).y[0, -1]
    assert 2.0 < exact < 6.0
    misses = []
    for count in (40, 80, 160):
        follower = PathFollower(build(Settings, paper), PATHS["circle"])
        for step in range(count + 1):
            follower.step(robot_at(step * duration / count), duration / count)
        misses.append(abs(float(follower.arc_length) - exact))
    assert misses[-1] < 1e-4
    assert 3.3 < misses[0] / misses[1] < 4.7
    assert 3.3 < misses[1] / misses[2] < 4.7


def test_the_cost_so_far_is_the_integral_of_the_running_cost(paper, figure_eight):
    follower = PathFollower(build(Settings, {**paper, "learning": False}), figure_eight)
    poses, periods = noisy_poses(figure_eight, 3, 60)
    times = np.concatenate([[0.0], np.cumsum(periods[1:])])
    rates = [
        float(follower.step(pose, dt).running_cost)
        for pose, dt in zip(poses, periods.tolist(), strict=True)
    ]
    assert float(follower.cost) == pytest.approx(trapezoid(rates, times), rel=1e-12)


@settings(max_examples=20)
@given(name=every_path, error=errors, dt=st.floats(1e-3, 10.0))
def test_after_a_hold_no_time_passes(paper, name, error, dt):
    path = PATHS[name]
    follower = PathFollower(build(Settings, paper), path, 0.3 * path.length)
    pose = pose_in_frame(error, path.frame(0.3 * path.length).pose)
    follower.step(pose, dt)
    assert follower.arc_length == 0.3 * path.length  # the first step lets no time pass either
    follower.step(pose, 0.02)
    place, learned, cost = follower.arc_length, follower.weights, follower.cost
    follower.hold()
    output = follower.step(advance_pose(pose, 1.0, 0.5, 1.0), dt)
    assert output.arc_length == place
    assert follower.arc_length == place
    assert follower.cost == cost
    assert follower.weights.critic.tolist() == learned.critic.tolist()
    assert follower.weights.actor.tolist() == learned.actor.tolist()
    assume(np.linalg.norm(error) > 0.1)
    follower.step(pose, 0.02)
    assert follower.arc_length != place


def test_step_at_takes_the_time_between_stamps(paper, figure_eight):
    poses, periods = noisy_poses(figure_eight, 8, 20)
    by_period = PathFollower(build(Settings, paper), figure_eight)
    by_time = PathFollower(build(Settings, paper), figure_eight)
    nanoseconds = np.round(periods * 1e9).astype(int)
    stamp = 1_700_000_000_000_000_000
    for pose, elapsed in zip(poses, nanoseconds.tolist(), strict=True):
        stamp += elapsed
        expected = by_period.step(pose, elapsed * 1e-9)
        found = by_time.step_at(pose, stamp)
        np.testing.assert_allclose(found.command, expected.command, rtol=1e-12)
    assert by_time.arc_length == pytest.approx(float(by_period.arc_length), rel=1e-12)


@pytest.mark.parametrize("jump", [0, -1, -3_000_000_000, 600_000_000, 10**15])
def test_step_at_lets_no_time_pass_over_a_gap_or_backwards(paper, figure_eight, jump):
    tuning = build(Settings, {**paper, "odom_timeout": 0.5})
    follower = PathFollower(tuning, figure_eight)
    poses, _ = noisy_poses(figure_eight, 9, 6)
    now = 10**18
    for pose in poses[:3]:
        now += 20_000_000
        follower.step_at(pose, now)
    place, cost, learned = float(follower.arc_length), float(follower.cost), follower.weights
    assert place > 0.0
    assert cost > 0.0
    now += jump
    assert follower.step_at(poses[3], now).arc_length == place
    assert follower.cost == cost
    assert follower.weights.critic.tolist() == learned.critic.tolist()
    now += 20_000_000
    assert follower.step_at(poses[4], now).arc_length > place


# --- learning -----------------------------------------------------------------------------------


def test_without_learning_the_weights_stay(paper, figure_eight):
    poses, periods = noisy_poses(figure_eight, 4, 25)
    for learning in (True, False):
        follower = PathFollower(build(Settings, {**paper, "learning": learning}), figure_eight)
        for pose, dt in zip(poses, periods.tolist(), strict=True):
            follower.step(pose, dt)
        same = follower.weights.critic.tolist() == list(paper["initial_critic_weights"])
        assert same is not learning
        same = follower.weights.actor.tolist() == list(paper["initial_actor_weights"])
        assert same is not learning


def driven(paper, figure_eight):
    """Return a follower that has learned and moved."""
    follower = PathFollower(build(Settings, paper), figure_eight, 5.0)
    for step in range(25):
        pose = pose_in_frame(np.array([0.1, 0.2, 0.3]), figure_eight.frame(5.0 + 0.01 * step).pose)
        follower.step(pose, 0.02)
    return follower


def test_a_reconfigured_follower_keeps_place_and_weights(paper, figure_eight):
    follower = driven(paper, figure_eight)
    other = follower.reconfigured(update(follower.settings, {"max_angular_vel": 0.05}))
    assert other.arc_length == follower.arc_length
    assert other.cost == follower.cost
    assert other.weights.critic.tolist() == follower.weights.critic.tolist()
    assert other.weights.actor.tolist() == follower.weights.actor.tolist()
    pose = pose_in_frame(np.array([0.1, 0.2, 0.3]), figure_eight.frame(5.25).pose)
    place = float(follower.arc_length)
    limited = other.step(pose, 0.02)
    free = follower.step(pose, 0.02)
    assert limited.arc_length == free.arc_length != place  # time goes on without a break
    assert abs(free.command[1]) > 0.05
    assert abs(limited.command[1]) == pytest.approx(0.05)


def test_another_basis_starts_with_the_weights_of_the_settings(paper, figure_eight):
    follower = driven(paper, figure_eight)
    initial = (0.1,) * 9
    changes = {"basis": "paper_misprinted", "initial_actor_weights": initial}
    other = follower.reconfigured(update(follower.settings, changes))
    assert other.arc_length == follower.arc_length
    assert other.weights.actor.tolist() == list(initial)
    assert other.weights.critic.tolist() == list(paper["initial_critic_weights"])


def test_reset_learning_returns_to_the_first_weights(paper, figure_eight):
    follower = driven(paper, figure_eight)
    place = float(follower.arc_length)
    assert follower.weights.critic.tolist() != list(paper["initial_critic_weights"])
    follower.reset_learning()
    assert follower.weights.critic.tolist() == list(paper["initial_critic_weights"])
    assert follower.weights.actor.tolist() == list(paper["initial_actor_weights"])
    assert follower.arc_length == place


def test_learning_at_rest_ends_where_the_laws_stand_still(printed, paper, figure_eight):
    follower = PathFollower(build(Settings, paper), figure_eight, 5.0)
    pose = pose_in_frame(np.array([-0.3, 0.2, 0.4]), figure_eight.frame(5.0).pose)
    assert follower.learn_at_rest(pose)
    assert follower.arc_length == 5.0
    critic, actor = follower.weights.critic, follower.weights.actor
    np.testing.assert_allclose(actor, critic, atol=1e-6)
    assert np.abs(critic - paper["initial_critic_weights"]).max() > 0.1
    state_cost, input_cost = printed.costs(paper)
    zeta = (-0.3, 0.2, 0.4, math.tanh(printed.k2 * 5.0))
    kappa = float(figure_eight.curvature(5.0))
    applied = printed.policy(zeta, kappa, actor, input_cost)
    measured = printed.bellman_error(zeta, kappa, applied, critic, state_cost, input_cost)
    sampled = printed.sampled_errors(paper, figure_eight, critic, actor)
    for rate in printed.weight_rates(critic, actor, measured, sampled):
        np.testing.assert_allclose(rate, 0.0, atol=1e-5)


def test_learning_at_rest_tells_when_it_did_not_settle(paper, figure_eight):
    values = {**paper, "critic_gain_sampled": 1e-3, "critic_gain_measured": 0.0}
    follower = PathFollower(build(Settings, values), figure_eight)
    assert not follower.learn_at_rest(figure_eight.frame(0.0).pose)
