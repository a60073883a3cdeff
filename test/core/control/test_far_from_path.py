"""Far from the path: the blend, and that a robot without reverse arrives from anywhere."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from adp_path_follower.core.control.far_from_path import WideRegion
from adp_path_follower.core.control.riccati import RiccatiSchedule, riccati_solution
from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.geometry import pose_in_frame
from adp_path_follower.core.path.library import circle, named_path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.study.simulation.simulate import simulate

HALF_WIDTHS = np.array([1.0, 2.0, 0.8])
START, END = 1.0, 1.5
LINE, BEND = named_path("line"), circle(0.5)
UNLIMITED = {
    "min_linear_vel": -math.inf,
    "max_linear_vel": math.inf,
    "max_angular_vel": math.inf,
}
kinds = st.sampled_from(["riccati", "approach"])
directions = (
    npst.arrays(float, 3, elements=st.floats(-1.0, 1.0))
    .filter(lambda direction: np.abs(direction).max() > 1e-3)
    .map(lambda direction: direction / np.abs(direction).max())
)
inputs = npst.arrays(float, 2, elements=st.floats(-0.4, 0.4))


def tuning(kind, **values):
    return build(
        Settings,
        {
            "wide_region": kind,
            "wide_region_levels": (START, END),
            "sample_half_widths": (*HALF_WIDTHS.tolist(), 0.5),
            **values,
        },
    )


def blended(kind, error, learned, curvature=0.0, **values):
    """Return the input at errors (..., 3) on a path of constant curvature."""
    path = BEND if curvature else LINE
    chosen = tuning(kind, **values)
    region = WideRegion(chosen, RiccatiSchedule(path, chosen.target, chosen.cost))
    zeta = np.concatenate([error, np.zeros((*error.shape[:-1], 1))], axis=-1)
    kappa = np.full(error.shape[:-1], curvature)
    steady = 0.5 * np.stack([np.ones_like(kappa), kappa], axis=-1)
    return region.blend(learned, zeta, kappa, steady)


def at_level(direction, level):
    return level * direction * HALF_WIDTHS


@settings(max_examples=60, deadline=None)
@given(kind=kinds, direction=directions, level=st.floats(0.0, START), learned=inputs)
def test_near_the_path_the_learned_input_stays_as_it_is(kind, direction, level, learned):
    error = at_level(direction, level * (1.0 - 1e-12))
    assert blended(kind, error, learned) is learned
    batch = np.stack([error, at_level(direction, 3.0)])
    several = blended(kind, batch, np.stack([learned, learned]))
    assert several[0].tolist() == learned.tolist()


@settings(max_examples=60, deadline=None)
@given(kind=kinds, direction=directions, level=st.floats(END, 5.0), learned=inputs)
def test_far_from_the_path_the_learned_input_does_not_matter(kind, direction, level, learned):
    error = at_level(direction, level * (1.0 + 1e-12))
    assert blended(kind, error, learned).tolist() == blended(kind, error, -learned).tolist()


@settings(max_examples=60, deadline=None)
@given(kind=kinds, direction=directions, low=st.floats(START, END), high=st.floats(START, END))
def test_in_between_the_share_of_the_far_policy_rises(kind, direction, low, high):
    low, high = sorted((low, high))

    def share(level):
        # The difference of two blends is what is left of the learned input.
        error = at_level(direction, level)
        there, here = (blended(kind, error, np.full(2, value)) for value in (1.0, 0.0))
        return 1.0 - (there - here)

    for axis in range(2):
        assert -1e-12 <= share(low)[axis] <= share(high)[axis] + 1e-12 <= 1.0 + 2e-12
    middle = 0.5 * (START + END)
    np.testing.assert_allclose(share(middle), 0.5, atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(kind=kinds, direction=directions, learned=inputs, curvature=st.sampled_from([0.0, 0.5]))
def test_the_input_is_continuous_on_the_way_out(kind, direction, learned, curvature):
    levels = np.linspace(0.5 * START, 1.5 * END, 4001)
    error = levels[:, None] * direction * HALF_WIDTHS
    # With a greater angle to the path it would be nearer to turn the other way round at the end.
    values = {"approach_angle": 1.2}
    applied = blended(kind, error, np.tile(learned, (len(levels), 1)), curvature, **values)
    assert np.abs(np.diff(applied, axis=0)).max() < 0.03


@settings(max_examples=60, deadline=None)
@given(
    kind=kinds,
    direction=directions,
    level=st.floats(0.0, 10.0),
    curvature=st.sampled_from([0.0, 0.5]),
)
def test_commands_stay_within_the_limits(kind, direction, level, curvature):
    error = at_level(direction, level)
    steady = 0.5 * np.array([1.0, curvature])
    applied = blended(kind, error, np.zeros(2), curvature)
    v, w = applied + steady
    assert -1e-12 <= v <= 1.0 + 1e-12
    assert -1.5 - 1e-12 <= w <= 1.5 + 1e-12


@settings(max_examples=60, deadline=None)
@given(kind=kinds, direction=directions, level=st.floats(END, 6.0))
def test_the_mirrored_error_has_the_mirrored_input(kind, direction, level):
    error = at_level(direction, level) * (1.0 + 1e-12)
    mirrored = blended(kind, error * [1.0, -1.0, -1.0], np.zeros(2))
    np.testing.assert_allclose(mirrored, blended(kind, error, np.zeros(2)) * [1.0, -1.0], atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(direction=directions, level=st.floats(END + 1e-9, 4.0), cost=st.floats(0.2, 5.0))
def test_far_away_riccati_is_the_linear_policy_in_the_half_angle_frame(
    printed, explicit, direction, level, cost
):
    error = at_level(direction, level)
    values = {**UNLIMITED, "input_cost": (cost, 1.0)}
    found = blended("riccati", error, np.zeros(2), 0.5, **values)
    chosen = tuning("riccati", **values)
    p = riccati_solution(0.5, chosen.target.desired_speed, chosen.target, chosen.cost)
    weights = [p[0, 0], 2 * p[0, 1], 2 * p[0, 2], p[1, 1], 2 * p[1, 2], p[2, 2]]
    gradient = explicit(2, "half_angle").gradient(error).T @ weights
    pull = printed.input_matrix([*error, 0.0])[:3].T @ gradient
    np.testing.assert_allclose(found, -0.5 * pull / [cost, 1.0], rtol=1e-3, atol=1e-3)


@settings(max_examples=60, deadline=None)
@given(direction=directions, scale=st.floats(1e-4, 1e-3))
def test_approach_is_the_riccati_law_for_small_errors(direction, scale):
    # Levels this small make everything far; heading and position are small against both.
    error = scale * direction
    values = {**UNLIMITED, "wide_region_levels": (1e-9, 2e-9), "input_cost": (2.0, 0.5)}
    found = blended("approach", error, np.zeros(2), **values)
    chosen = tuning("approach", **values)
    p = riccati_solution(0.0, chosen.target.desired_speed, chosen.target, chosen.cost)
    s, y, theta = error
    # A robot that does not face along the path moves towards it by driving: of second order.
    driving = p[0, 0] * s + p[1, 1] * y * theta
    expected = [-driving / 2.0, -(p[1, 2] * y + p[2, 2] * theta) / 0.5]
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-6)


@settings(max_examples=60, deadline=None)
@given(y=st.floats(0.3, 1e6), side=st.sampled_from([-1.0, 1.0]), angle=st.floats(0.3, 1.4))
def test_approach_holds_a_heading_of_no_more_than_its_angle(y, side, angle):
    values = {**UNLIMITED, "approach_angle": angle, "wide_region_levels": (1e-9, 2e-9)}

    def steering(theta):
        return blended("approach", np.array([0.0, side * y, theta]), np.zeros(2), **values)[1]

    # Facing along the path it turns towards it; facing it at the angle it turns no further.
    assert side * steering(0.0) < 0.0
    assert side * steering(-side * angle) >= -1e-9


# --- the closed loop ----------------------------------------------------------------------------


def test_the_riccati_policy_would_wait_for_ever_where_approach_goes_on():
    stuck = np.array([1.53, -2.23, -1.88])
    pose = pose_in_frame(stuck, LINE.frame(10.0).pose)
    commands = {}
    for kind in ("riccati", "approach"):
        follower = PathFollower(build(Settings, {"wide_region": kind}), LINE, 10.0)
        commands[kind] = follower.step(pose, 0.01).command
    assert commands["riccati"][0] == 0.0
    assert abs(commands["riccati"][1]) < 0.02
    assert np.abs(commands["approach"]).max() > 0.5


def test_no_command_is_beyond_a_limit_not_even_by_rounding():
    path, chosen = named_path("lissajous"), build(Settings, {"min_linear_vel": 0.0})
    follower, limits = PathFollower(chosen, path, 10.0), chosen.limits
    for error in np.random.default_rng(1).uniform(-3.0, 3.0, (2000, 3)):
        pose = pose_in_frame(error, path.frame(follower.arc_length).pose)
        command = follower.step(pose, 0.01).command
        assert (limits.lower <= command).all(), command
        assert (command <= limits.upper).all(), command


@pytest.mark.parametrize("name", ["line", "circle:0.5", "lissajous"])
def test_a_robot_without_reverse_arrives_from_anywhere(name):
    starts = np.random.default_rng(2024).uniform(-1.0, 1.0, (60, 3)) * [5.0, 5.0, math.pi]
    limits = {"min_linear_vel": 0.0, "max_linear_vel": 1.0, "max_angular_vel": 1.5}
    result = simulate(
        build(Settings, limits), named_path(name), starts, learning="warm", duration=45, rate=25
    )
    assert not result.failed.any()
    assert np.linalg.norm(result.final_error, axis=1).max() < 0.05
    assert np.isfinite(result.settling_time).all()
    assert (result.max_inputs <= [1.0 + 1e-12, 1.5 + 1e-12]).all()


@pytest.mark.parametrize("slowest", [-math.inf, -1.0], ids=["unlimited", "reversing at 1 m/s"])
@pytest.mark.parametrize("name", ["line", "circle:0.5", "lissajous"])
def test_a_robot_that_can_reverse_does_not_drive_away(name, slowest):
    spread = np.random.default_rng(5).uniform(-1.0, 1.0, (100, 3)) * [3.0, 3.0, math.pi]
    starts = np.vstack([spread, [[2.0, 3.0, 3.1], [1.5, 2.0, 3.1]]])
    limits = UNLIMITED if math.isinf(slowest) else {"min_linear_vel": slowest}
    result = simulate(
        build(Settings, limits), named_path(name), starts, learning="frozen", duration=25, rate=25
    )
    assert not result.failed.any()
    assert np.isfinite(result.settling_time).all()
    assert np.linalg.norm(result.final_error, axis=1).max() < 0.05


@pytest.mark.parametrize(
    ("start", "optimal_cost"),  # by bench/endurance/region.py far
    [
        ((-27.309709, 4.295834, -2.222706), 3007.74),  # far behind its target
        ((2.063654, 26.681417, -1.061869), 6435.19),  # far aside
    ],
)
def test_from_far_away_the_approach_costs_little_more_than_the_optimum(start, optimal_cost):
    result = simulate(build(Settings, {}), LINE, start, duration=150.0, rate=20.0, learning="warm")
    assert 0.999 < float(result.cost[0]) / optimal_cost < 1.02
