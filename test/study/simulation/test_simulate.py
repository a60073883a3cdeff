"""The closed loop against the paper's printed laws, integrated independently."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp, trapezoid

from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.path.library import circle, named_path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.study.simulation.simulate import PAPER_START, simulate
from sim_unicycle.settings import PlantSettings

STARTS = np.array([[-0.5, 0.25, -0.5], [0.3, -0.4, 1.0], [0.0, 0.8, 0.2]])
# Too far for any follower: one beyond what a float's squares hold, one merely very far away.
LOST_STARTS = [(1e5, 0.0, 0.0), (1e5, 3e4, 0.0), (0.0, 1e30, 0.0), (1e308, 0.0, 0.0)]


@pytest.fixture(scope="module")
def tuning(paper):
    return build(Settings, paper)


# --- the paper's run ----------------------------------------------------------------------------


def test_cost_of_the_papers_run(tuning, figure_eight):
    """Without learning; test_paper.py holds the costs with it."""
    result = simulate(tuning, figure_eight, duration=40.0, learning="frozen")
    assert result.cost.shape == (1,)
    assert float(result.cost[0]) == pytest.approx(0.6285, rel=5e-3)
    assert not result.failed.any()
    np.testing.assert_array_equal(result.starts, [PAPER_START])


def test_the_frozen_policy_is_the_integral_of_the_printed_equations(
    printed, paper, tuning, figure_eight
):
    actor = np.array(paper["initial_actor_weights"])
    state_cost, input_cost = printed.costs(paper)

    def rate(_, state):
        kappa = float(figure_eight.curvature(state[3]))
        zeta = (*state[:3], math.tanh(printed.k2 * state[3]))
        applied = printed.policy(zeta, kappa, actor, input_cost)
        zeta_rate = printed.drift(zeta, kappa) + printed.input_matrix(zeta) @ applied
        error = state[:3]
        cost = error @ state_cost @ error + applied @ input_cost @ applied
        speed = printed.v_des * math.cos(state[2]) + printed.k1 * state[0]
        return [*zeta_rate[:3], speed, cost]

    start = [*PAPER_START, 0.0, 0.0]
    exact = solve_ivp(rate, (0.0, 8.0), start, rtol=1e-9, atol=1e-10).y[:, -1]
    misses = []
    for frequency in (50.0, 200.0):
        options = {"duration": 8.0, "rate": frequency, "learning": "frozen", "record": True}
        result = simulate(tuning, figure_eight, **options)
        misses.append(abs(float(result.cost[0]) - exact[4]))
    assert misses[1] < 2e-3 * exact[4]
    assert misses[1] < 0.3 * misses[0]  # first order in the period for which commands are held
    np.testing.assert_allclose(result.final_error[0], exact[:3], atol=2e-3)
    assert result.trajectories.arc_length[0, -1] == pytest.approx(exact[3], abs=2e-3)


def test_the_learning_run_is_the_integral_of_the_printed_laws(printed, paper, figure_eight):
    values = {**paper, "samples_per_axis": (2, 2, 2, 2)}
    state_cost, input_cost = printed.costs(paper)

    def rate(state):
        error, s_p, critic, actor = state[:3], state[3], state[4:13], state[13:22]
        kappa = float(figure_eight.curvature(s_p))
        zeta = (*error, math.tanh(printed.k2 * s_p))
        applied = printed.policy(zeta, kappa, actor, input_cost)
        zeta_rate = printed.drift(zeta, kappa) + printed.input_matrix(zeta) @ applied
        speed = printed.v_des * math.cos(error[2]) + printed.k1 * error[0]
        measured = printed.bellman_error(zeta, kappa, applied, critic, state_cost, input_cost)
        sampled = printed.sampled_errors(values, figure_eight, critic, actor)
        return np.concatenate(
            [zeta_rate[:3], [speed], *printed.weight_rates(critic, actor, measured, sampled)]
        )

    weights = paper["initial_critic_weights"]
    state, h = np.array([*PAPER_START, 0.0, *weights, *weights]), 0.02
    for _ in range(150):
        first = rate(state)
        second = rate(state + 0.5 * h * first)
        third = rate(state + 0.5 * h * second)
        state = state + h / 6.0 * (first + 2.0 * second + 2.0 * third + rate(state + h * third))

    tuning = build(Settings, values)
    misses = []
    for frequency in (100.0, 400.0):
        result = simulate(tuning, figure_eight, duration=3.0, rate=frequency)
        found = [result.final_error[0], result.weights.critic[0], result.weights.actor[0]]
        misses.append(np.abs(np.concatenate(found) - np.delete(state, 3)).max())
    assert np.abs(state[4:13] - weights).max() > 0.1  # much was learned
    assert misses[0] < 0.02
    assert misses[1] < 0.4 * misses[0]  # first order in the control period


def test_the_misprinted_basis_leaves_the_path(paper, figure_eight):
    values = {**paper, "basis": "paper_misprinted"}
    result = simulate(build(Settings, values), figure_eight, duration=10.0, record=True)
    assert np.linalg.norm(result.trajectories.error[0], axis=-1).max() > 1.0


def test_the_misprinted_basis_is_no_error_however_long_it_runs(paper):
    values = {**paper, "basis": "paper_misprinted"}
    result = simulate(build(Settings, values), circle(0.5), duration=30.0, rate=20.0)
    assert result.failed[0] == math.isnan(result.cost[0])
    assert result.failed[0] or result.cost[0] > 100.0


# --- control periods ----------------------------------------------------------------------------


@pytest.mark.parametrize(("frequency", "duration"), [(10.0, 12.0), (1000.0, 2.0)])
def test_slow_and_fast_control_stays_near_the_path(tuning, figure_eight, frequency, duration):
    result = simulate(tuning, figure_eight, duration=duration, rate=frequency, record=True)
    reference = simulate(tuning, figure_eight, duration=duration, rate=100.0)
    assert not result.failed[0]
    assert np.isfinite(result.weights.critic).all()
    error = np.linalg.norm(result.trajectories.error[0], axis=-1)
    assert error.max() < 1.0
    assert float(result.cost[0]) == pytest.approx(float(reference.cost[0]), rel=0.01)


# --- many starts --------------------------------------------------------------------------------


def outcome(result, index):
    return np.concatenate(
        [
            [result.cost[index], result.settling_time[index], result.excitation[index]],
            *(result.starts[index], result.final_error[index], result.max_inputs[index]),
            *(result.weights.critic[index], result.weights.actor[index]),
        ]
    )


@pytest.mark.parametrize("learning", ["cold", "frozen"])
@pytest.mark.parametrize("limited", [True, False])
def test_three_starts_at_once_are_three_runs(paper, figure_eight, learning, limited):
    limits = {"min_linear_vel": 0.0, "max_linear_vel": 1.0, "max_angular_vel": 1.5}
    tuning = build(Settings, {**paper, **(limits if limited else {})})
    options = {"duration": 2.0, "rate": 50.0, "learning": learning, "start_arc_length": 12.0}
    together = simulate(tuning, figure_eight, STARTS, record=True, **options)
    for index, start in enumerate(STARTS):
        single = simulate(tuning, figure_eight, start, record=True, **options)
        np.testing.assert_allclose(outcome(together, index), outcome(single, 0), atol=1e-9)
        for name in ("pose", "error", "arc_length", "command", "actor_weights"):
            np.testing.assert_allclose(
                getattr(together.trajectories, name)[index],
                getattr(single.trajectories, name)[0],
                atol=1e-9,
            )


def test_more_starts_than_a_block_keep_their_order(tuning, figure_eight):
    starts = np.random.default_rng(1).uniform(-0.5, 0.5, (300, 3))
    options = {"duration": 0.1, "rate": 50.0}
    together = simulate(tuning, figure_eight, starts, at_once=128, **options)
    np.testing.assert_array_equal(together.starts, starts)
    assert together.cost.shape == (300,)
    for index in (0, 127, 128, 255, 256, 299):
        single = simulate(tuning, figure_eight, starts[index], **options)
        np.testing.assert_allclose(outcome(together, index), outcome(single, 0), atol=1e-9)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of the lost run's numbers
@pytest.mark.parametrize("lost", LOST_STARTS)
@pytest.mark.parametrize("name", ["lissajous", "line"])
def test_a_run_that_is_lost_is_reported_and_the_others_go_on(tuning, lost, name):
    path = named_path(name)
    options = {"duration": 1.0, "rate": 50.0}
    result = simulate(tuning, path, [STARTS[0], lost, STARTS[1]], record=True, **options)
    assert result.failed.tolist() == [False, True, False]
    poses = result.trajectories.pose[1]
    assert np.isfinite(poses).all()
    assert (poses == poses[0]).all()  # a robot that is lost stands still
    assert math.isnan(result.cost[1])
    assert np.isnan(result.final_error[1]).all()
    assert math.isinf(result.settling_time[1])
    for index, start in ((0, STARTS[0]), (2, STARTS[1])):
        single = simulate(tuning, path, start, **options)
        np.testing.assert_allclose(outcome(result, index), outcome(single, 0), atol=1e-9)


@pytest.mark.parametrize("learning", ["cold", "warm"])
@pytest.mark.parametrize("lost", LOST_STARTS)
def test_a_lost_run_leaves_the_learner_of_the_others_alone(figure_eight, learning, lost):
    tuning = build(Settings, {"basis_degree": 3, "sample_count": 64})
    starts = [STARTS[0], STARTS[1], STARTS[2]]
    alone = simulate(tuning, figure_eight, starts, duration=2.0, rate=50.0, learning=learning)
    with np.errstate(all="ignore"):
        beside = simulate(
            tuning, figure_eight, [*starts, lost], duration=2.0, rate=50.0, learning=learning
        )
    assert beside.failed.tolist() == [False, False, False, True]
    np.testing.assert_allclose(beside.cost[:3], alone.cost, rtol=1e-9)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of starts up to 1e308
@settings(max_examples=25)
@given(
    start=st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 3),
    arc_length=st.floats(-1e6, 1e6),
)
@example(start=(0.0, 1.6878221678120006e41, 0.0), arc_length=-186.765625)  # a singular matrix
def test_any_finite_start_has_an_outcome(tuning, figure_eight, start, arc_length):
    options = {"duration": 0.1, "rate": 50.0, "start_arc_length": arc_length}
    result = simulate(tuning, figure_eight, start, **options)
    assert result.failed[0] or math.isfinite(result.cost[0])


# --- what is reported ---------------------------------------------------------------------------


def test_the_record_and_the_summary_agree(paper, figure_eight):
    values = {**paper, "max_linear_vel": 0.6, "min_linear_vel": 0.0, "max_angular_vel": 1.0}
    result = simulate(build(Settings, values), figure_eight, STARTS, duration=8.0, record=True)
    record = result.trajectories
    np.testing.assert_allclose(record.time, np.arange(801) / 100.0, atol=1e-12)
    for name, shape in (
        *(("pose", (3, 801, 3)), ("error", (3, 801, 3)), ("arc_length", (3, 801))),
        *(("command", (3, 801, 2)), ("modified_input", (3, 801, 2))),
        *(("critic_weights", (3, 801, 9)), ("actor_weights", (3, 801, 9))),
        ("bellman_error", (3, 801)),
    ):
        assert getattr(record, name).shape == shape
    np.testing.assert_allclose(record.error[:, 0], STARTS, atol=1e-9)
    np.testing.assert_allclose(result.final_error, record.error[:, -1], atol=1e-12)
    np.testing.assert_allclose(
        result.max_inputs, np.abs(record.command[:, :-1]).max(axis=1), atol=1e-12
    )
    assert record.command[..., 0].max() <= 0.6 + 1e-12
    rates = (record.error**2).sum(axis=-1) + (record.modified_input**2).sum(axis=-1)
    np.testing.assert_allclose(result.cost, trapezoid(rates, record.time, axis=1), rtol=5e-3)
    for index in range(3):
        outside = np.flatnonzero(np.linalg.norm(record.error[index], axis=-1) >= 0.05)
        last = outside[-1] + 1
        expected = record.time[last] if last < 801 else math.inf
        assert result.settling_time[index] == pytest.approx(expected)
    np.testing.assert_array_equal(result.weights.critic, record.critic_weights[:, -1])


def test_the_recorded_robot_moves_by_its_commands(tuning, figure_eight):
    record = simulate(tuning, figure_eight, STARTS[0], duration=2.0, record=True).trajectories
    poses, commands = record.pose[0], record.command[0]
    # A chord of the arc under a held twist: its length and direction in closed form.
    half = 0.005 * commands[:-1, 1]
    chord = 0.01 * commands[:-1, 0] * np.sin(half) / half
    moved = poses[:-1, 0] + 1j * poses[:-1, 1] + chord * np.exp(1j * (poses[:-1, 2] + half))
    np.testing.assert_allclose(poses[1:, 0] + 1j * poses[1:, 1], moved, atol=1e-9)
    np.testing.assert_allclose(np.diff(poses[:, 2]), 2.0 * half, atol=1e-9)


def test_warm_learning_starts_with_settled_weights(paper, tuning, figure_eight):
    options = {"duration": 0.02, "record": True}
    cold = simulate(tuning, figure_eight, learning="cold", **options).trajectories
    warm = simulate(tuning, figure_eight, learning="warm", **options).trajectories
    initial = paper["initial_critic_weights"]
    np.testing.assert_array_equal(cold.critic_weights[0, 0], initial)
    assert np.abs(warm.critic_weights[0, 0] - initial).max() > 0.1
    np.testing.assert_allclose(warm.actor_weights[0, 0], warm.critic_weights[0, 0], atol=1e-6)
    changes = [np.abs(np.diff(run.critic_weights[0], axis=0)).max() for run in (cold, warm)]
    assert changes[1] < 0.1 * changes[0]


def test_progress_goes_from_start_to_end(tuning, figure_eight):
    seen = []
    simulate(tuning, figure_eight, STARTS[0], duration=1.0, rate=50.0, progress=seen.append)
    assert len(seen) > 5
    assert seen == sorted(seen)
    assert seen[0] == 0.0
    assert 0.8 < seen[-1] <= 1.0


def test_noise_is_the_same_in_every_run_with_one_seed(tuning, figure_eight):
    options = {"duration": 1.0, "rate": 50.0, "record": True}

    def error(seed):
        plant = PlantSettings(position_noise=0.02, heading_noise=0.01, seed=seed)
        return simulate(tuning, figure_eight, STARTS, plant=plant, **options).trajectories.error

    np.testing.assert_array_equal(error(3), error(3))
    assert np.abs(error(3) - error(4)).max() > 1e-3


def test_a_lagging_robot_is_followed_too(tuning, figure_eight):
    plant = PlantSettings(velocity_lag=0.1, command_delay=0.05)
    result = simulate(tuning, figure_eight, duration=10.0, rate=50.0, plant=plant)
    assert not result.failed[0]
    assert np.linalg.norm(result.final_error[0]) < 0.2


# --- refusals -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        {"starts": [math.nan, 0.0, 0.0]},
        {"starts": [[0.0, 0.0, 0.0], [0.0, math.inf, 0.0]]},
        {"starts": [0.0, 0.0]},
        {"starts": np.zeros((2, 2, 3))},
        {"starts": 1.0},
        {"starts": []},
        {"starts": np.zeros((0, 3))},
        {"starts": "here"},
        {"starts": [[0.0, 0.0, 0.0], [1.0]]},
        {"duration": 0.0},
        {"duration": -1.0},
        {"duration": math.nan},
        {"duration": math.inf},
        {"rate": 0.0},
        {"rate": -10.0},
        {"rate": math.nan},
        {"rate": math.inf},
        {"rate": 1e5},
        {"learning": "hot"},
        {"learning": ""},
        {"start_arc_length": math.nan},
        {"start_arc_length": math.inf},
    ],
    ids=repr,
)
def test_bad_arguments_are_refused_in_a_sentence(tuning, figure_eight, options):
    with pytest.raises(AdpError) as caught:
        simulate(tuning, figure_eight, **{"duration": 0.1, **options})
    assert next(iter(options)) in str(caught.value).replace(" ", "_")
    assert "\n" not in str(caught.value)


def test_a_simulated_robot_is_held_on_the_path_as_a_driven_one_is():
    plant, found = PlantSettings(velocity_lag=0.1, bias=0.04), []
    for tight_within in (0.0, 0.01):
        tuning = build(
            Settings,
            {"robot_model": "given", "robot_lags": [0.1, 0.1], "tight_within": tight_within},
        )
        result = simulate(tuning, named_path("line"), STARTS[2], duration=15.0, plant=plant)
        found.append(abs(result.final_error[0, 1]))
    assert found[1] < 0.6 * found[0]
