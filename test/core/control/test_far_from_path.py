"""Far from the path: the blend, and that a robot without reverse arrives from anywhere."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from steady import steady_schedule

from adp_path_follower.core.control.far_from_path import WideRegion
from adp_path_follower.core.control.lookahead import FarFromPath
from adp_path_follower.core.control.riccati import riccati_solution
from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.geometry import advance_pose, pose_in_frame, tracking_error
from adp_path_follower.core.path.library import circle, named_path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.study.simulation.simulate import simulate
from sim_unicycle.settings import PlantSettings

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


def region_and_place(kind, error, curvature=0.0, **values):
    """Return the region and its arguments at errors (..., 3) on a path of constant curvature."""
    path = BEND if curvature else LINE
    chosen = tuning(kind, **values)
    region = FarFromPath(chosen, steady_schedule(path, chosen.target, chosen.cost))
    zeta = np.concatenate([error, np.zeros((*error.shape[:-1], 1))], axis=-1)
    kappa = np.full(error.shape[:-1], curvature)
    steady = 0.5 * np.stack([np.ones_like(kappa), kappa], axis=-1)
    return region, (np.zeros_like(kappa), zeta, kappa, steady)


def blended(kind, error, learned, curvature=0.0, **values):
    region, place = region_and_place(kind, error, curvature, **values)
    return region.blend(learned, 0.0, *place)


def at_level(direction, level):
    return level * direction * HALF_WIDTHS


@settings(max_examples=60)
@given(kind=kinds, direction=directions, level=st.floats(0.0, START), learned=inputs)
def test_near_the_path_the_learned_input_stays_as_it_is(kind, direction, level, learned):
    error = at_level(direction, level * (1.0 - 1e-12))
    assert blended(kind, error, learned) is learned
    batch = np.stack([error, at_level(direction, 3.0)])
    several = blended(kind, batch, np.stack([learned, learned]))
    assert several[0].tolist() == learned.tolist()


@settings(max_examples=60)
@given(kind=kinds, direction=directions, level=st.floats(END, 5.0), learned=inputs)
def test_far_from_the_path_the_learned_input_does_not_matter(kind, direction, level, learned):
    error = at_level(direction, level * (1.0 + 1e-12))
    assert blended(kind, error, learned).tolist() == blended(kind, error, -learned).tolist()
    region, place = region_and_place(kind, error)
    assert region.drives_alone(region.region.share(error))
    assert region.far_input(0.0, *place).tolist() == blended(kind, error, learned).tolist()


@settings(max_examples=60)
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


@settings(max_examples=40)
@given(kind=kinds, direction=directions, learned=inputs, curvature=st.sampled_from([0.0, 0.5]))
def test_the_input_is_continuous_on_the_way_out(kind, direction, learned, curvature):
    levels = np.linspace(0.5 * START, 1.5 * END, 4001)
    error = levels[:, None] * direction * HALF_WIDTHS
    # With a greater angle to the path it would be nearer to turn the other way round at the end.
    values = {"approach_angle": 1.2}
    applied = blended(kind, error, np.tile(learned, (len(levels), 1)), curvature, **values)
    assert np.abs(np.diff(applied, axis=0)).max() < 0.03


@settings(max_examples=60)
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


@settings(max_examples=60)
@given(kind=kinds, direction=directions, level=st.floats(END, 6.0))
def test_the_mirrored_error_has_the_mirrored_input(kind, direction, level):
    error = at_level(direction, level) * (1.0 + 1e-12)
    mirrored = blended(kind, error * [1.0, -1.0, -1.0], np.zeros(2))
    np.testing.assert_allclose(mirrored, blended(kind, error, np.zeros(2)) * [1.0, -1.0], atol=1e-9)


@settings(max_examples=60)
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


@settings(max_examples=60)
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


@settings(max_examples=60)
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


# J* from starts in ±30 m, by collocation from six guesses over 150 s, on closed paths 100 to 120 s.
# From (28.717, -6.386, -1.119) on the line they lead to 3640.19, undercut by 0.5 %: left out.
FAR_OPTIMA = {
    "line": {
        (-27.309709, 4.295835, -2.222706): 3007.7602,  # far behind its target
        (2.063654, 26.681417, -1.061869): 6435.1931,  # far aside
        (21.730839, 17.959494, 1.202794): 4580.6892,  # far ahead
        (24.517271, -1.960103, 2.936056): 2326.3313,  # facing backwards
        (13.126283, -9.27861, -0.270116): 1069.8316,
        (17.181788, -8.589834, 1.068957): 1465.0508,
    },
    "circle:0.2": {
        (-16.487569, -11.990023, 2.347106): 2434.3881,
        (3.209841, 29.730017, 1.838849): 5965.8163,
    },
    "lissajous": {
        (-6.921109, 19.491074, -1.139073): 2735.4626,
        (11.541957, 14.79586, -0.684334): 1762.6531,
    },
}


@pytest.mark.parametrize("name", FAR_OPTIMA)
def test_from_far_away_a_robot_costs_hardly_more_than_the_optimum(name):
    starts, optimal_costs = list(FAR_OPTIMA[name]), list(FAR_OPTIMA[name].values())
    result = simulate(
        build(Settings, {}), named_path(name), starts, duration=100.0, rate=10.0, learning="warm"
    )
    ratio = result.cost / optimal_costs
    assert ratio.min() > 0.999
    assert np.median(ratio) < 1.001
    assert ratio.max() < 1.004


# J* from starts in ±5 m, 1.5 m before the sharpest bend, by collocation; the speed along the path.
BEND_OPTIMA = {
    0.5: {
        (1.927434, 3.158171, -0.977621): 31.864338,
        (-4.551618, 0.715973, -2.222706): 51.993201,
        (2.187714, -1.546435, -0.270116): 13.202109,
        (4.759379, 2.81466, 2.160097): 104.433771,  # turning to the other side costs 6 % more
        (0.551144, 4.416214, -3.026448): 52.158262,
        (3.891839, -1.102415, -1.685526): 43.327966,
        (0.343942, 4.446903, -1.061869): 40.436272,
        (4.086212, -0.326684, 2.936056): 51.903390,
        (3.02421, -3.152048, 1.229141): 49.287075,
        (4.668302, 1.712984, 2.074089): 82.077384,
        (4.245302, 1.638639, 0.224119): 51.676595,
        (-1.960918, -4.60101, -1.605145): 89.2505,  # behind it and aside: 3.8 % more with a piece
        (4.031718, -4.323217, 1.0853): 99.694815,
        (2.050858, -2.899662, -0.475063): 33.280874,
        (3.541873, 1.798958, -1.109185): 41.038501,
    },
    0.25: {
        (2.783835, -3.053613, -0.209098): 57.999239,  # once 13 %, by counting too long a piece
        (2.73956, -0.611216, 2.253137): 27.334997,
        (3.276312, 1.316644, 1.621613): 46.694449,
    },
    0.22: {
        (0.806344, -0.864643, 0.361767): 4.361832,
        (0.410172, -0.579932, -0.158354): 1.932404,
        (0.708375, 0.359792, -0.369728): 1.775835,
    },
    0.15: {
        (-1.187049, 0.541668, 3.039997): 15.059656,  # turned to the side that costs 38 % more
        (1.230515, -1.739797, -0.475063): 18.549734,
        (2.125124, 1.079375, -1.109185): 21.947232,
        (0.410172, -0.579932, -0.158354): 2.490044,
    },
    0.1: {
        (0.410172, -0.579932, -0.158354): 3.141272,
        (0.708375, 0.359792, -0.369728): 3.142951,
    },
}


@pytest.mark.parametrize("speed", BEND_OPTIMA)
def test_before_a_sharp_bend_a_robot_turns_to_where_the_path_will_be(speed):
    starts, optimal_costs = list(BEND_OPTIMA[speed]), list(BEND_OPTIMA[speed].values())
    result = simulate(
        *(build(Settings, {"desired_speed": speed}), named_path("lissajous"), starts),
        start_arc_length=15.527,
        duration=min(20.0 / speed, 60.0),
        rate=50.0,
        learning="warm",
    )
    ratio = result.cost / optimal_costs
    assert ratio.min() > 0.999
    assert np.median(ratio) < 1.0015
    assert ratio.max() < 1.01


@pytest.mark.parametrize(
    ("speed", "zeta", "covered"),
    [
        (0.5, [4.0, 0.0, 3.0, 0.5], 1.2),  # 0.3 of the distance ahead [m]
        (0.5, [2.0, -4.0, -1.0, 0.5], 0.96),  # aside counts 0.3 of that
        (0.5, [14.0, 0.0, 3.0, 0.5], 3.0),  # 3 m at most
        (0.25, [4.0, 0.0, 0.5, 0.5], 1.0),  # a slow robot waits there, for 1 m at most
        (0.5, [-4.0, 3.0, 0.3, 0.5], 0.0),  # behind its target, more than aside: as it is
        (0.1, [-4.0, 3.0, 3.0, 0.5], 0.72),  # 0.8 * 0.3 m for each rad that a slow robot turns
        (0.1, [0.4, 0.0, -1.0, 0.5], 0.4),  # the longer of both: all that a slow one is ahead
    ],
)
def test_the_circle_that_counts_ends_where_the_coming_piece_of_path_does(speed, zeta, covered):
    chosen, path = build(Settings, {"desired_speed": speed}), named_path("lissajous")
    region = WideRegion(chosen, steady_schedule(path, chosen.target, chosen.cost))
    place, state = np.array(15.527), np.array(zeta)
    found, curvature = region.seen(state, place)
    robot = pose_in_frame(state[:3], path.frame(place).pose)
    arc = advance_pose(np.zeros(3), covered, covered * curvature, 1.0)
    there = tracking_error(robot, path.frame(place + covered).pose)
    np.testing.assert_allclose(tracking_error(found[:3], arc), there, atol=1e-6)
    assert found[3] == 0.5
    if covered:
        assert abs(curvature) > 1.1 * abs(path.curvature(15.527))  # a sharp bend comes
    else:
        np.testing.assert_allclose(found, state, atol=1e-9)
        assert curvature == pytest.approx(path.curvature(15.527))
    if covered > 1.0:
        assert abs(found[1] - state[1]) > 0.05  # the bend is no circle
    many, curvatures = region.seen(np.stack([np.zeros(4), state]), np.full(2, 15.527))
    np.testing.assert_allclose(many[1], found, atol=1e-9)
    assert curvatures[1] == pytest.approx(curvature)


@settings(max_examples=30)
@given(
    error=npst.arrays(float, 3, elements=st.floats(-3.0, 3.0)),
    kappa=st.floats(0.1, 1.2),
    side=st.sampled_from([-1.0, 1.0]),
)
def test_on_a_circle_a_robot_is_seen_as_it_is(error, kappa, side):
    chosen, path = build(Settings, {}), circle(side * kappa)
    region = WideRegion(chosen, steady_schedule(path, chosen.target, chosen.cost))
    zeta = np.array([*error, 0.0])
    found, curvature = region.seen(zeta, np.array(0.0))
    np.testing.assert_allclose(found, zeta, atol=1e-6)
    assert curvature == pytest.approx(side * kappa, abs=1e-6)


@pytest.mark.parametrize("curvature", [0.0, 0.5])
def test_one_robot_has_the_grid_policy_of_one_of_many(curvature):
    """Near and beyond, also where it faces backwards: numbers and arrays take other ways."""
    errors = np.random.default_rng(4).uniform(-1.0, 1.0, (60, 3)) * [12.0, 12.0, math.pi]
    errors[::6, 2] = math.pi - 0.1
    together = blended("value_grid", errors, np.zeros((60, 2)), curvature)
    alone = [blended("value_grid", error, np.zeros(2), curvature) for error in errors]
    np.testing.assert_allclose(alone, together, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "starts"),
    [
        ("line", [[15.0, 0.0, 0.0], [-15.0, 0.0, math.pi]]),
        ("lissajous", [[15.0, 0.0, math.pi], [0.0, 15.0, math.pi / 2.0]]),
    ],
)
def test_from_far_away_neither_noise_nor_lag_keeps_a_robot_between_two_ways(name, starts):
    """Where two ways cost the same the robot takes one, and does not turn to and fro."""
    sides = [[] for _ in starts]

    def note(runs, time, pose, output):
        far = np.hypot(*output.error[:, :2].T) > 5.0
        hard = np.abs(output.command[:, 1]) > 0.7
        for run in np.flatnonzero(far & hard):
            sides[runs.start + run].append(np.sign(output.command[run, 1]))

    imperfect = PlantSettings(
        position_noise=0.01, heading_noise=0.01, angular_lag=0.2, command_delay=0.1
    )
    result = simulate(
        *(build(Settings, {}), named_path(name), starts),
        duration=60.0,
        rate=20.0,
        learning="frozen",
        plant=imperfect,
        observe=note,
    )
    assert not result.failed.any()
    assert np.linalg.norm(result.final_error[:, :2], axis=1).max() < 0.2
    assert max((np.diff(turns) != 0.0).sum() for turns in sides) <= 3
