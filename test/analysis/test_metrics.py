"""The numbers of `adp analyze` against closed forms."""

from __future__ import annotations

import math
import re
from pathlib import Path as FilePath

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from adp_path_follower.analysis import events
from adp_path_follower.analysis.bag_analysis import BagAnalysis, analyse_bag, number
from adp_path_follower.analysis.metrics import approach
from adp_path_follower.analysis.motion import motion_of
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.drive import project
from adp_path_follower.core.path.library import lissajous
from adp_path_follower.drawing.charts import extremes
from bag_messages import (
    LINE,
    SECOND,
    drive_on_line,
    learner_run,
    odometry,
    path_message,
    text,
    twist,
    twist_stamped,
    write_bag,
)


def analysed(folder: FilePath, messages, name: str = "bag") -> BagAnalysis:
    return analyse_bag(write_bag(folder / name, messages), {}, 1, folder / "trajectory.tum")


def test_cross_track_of_a_sine(tmp_path):
    """A sine of amplitude A: RMS A/√2, mean 2A/π, 95 % below A sin(0.95 π/2)."""
    amplitude = 0.1
    found = analysed(
        tmp_path,
        drive_on_line(
            lambda time: amplitude * math.sin(math.pi * time), duration=30.0, heading=0.05
        ),
    ).metrics
    assert found["duration"] == pytest.approx(30.0)
    assert found["cross_track_rms"] == pytest.approx(amplitude / math.sqrt(2.0), rel=1e-3)
    assert found["steady_cross_track_rms"] == pytest.approx(amplitude / math.sqrt(2.0), rel=1e-3)
    assert found["cross_track_mean"] == pytest.approx(2.0 * amplitude / math.pi, rel=1e-3)
    assert found["cross_track_median"] == pytest.approx(amplitude / math.sqrt(2.0), rel=2e-3)
    assert found["cross_track_p95"] == pytest.approx(
        amplitude * math.sin(0.475 * math.pi), rel=2e-3
    )
    assert found["cross_track_max"] == pytest.approx(amplitude, rel=1e-6)
    for statistic in ("rms", "mean", "median", "p95", "max"):
        assert found[f"heading_{statistic}"] == pytest.approx(0.05)
    assert found["path_covered"] == pytest.approx(15.0, abs=1e-6)


def test_a_short_run_is_steady_after_a_third(tmp_path):
    def lateral(time: float) -> float:
        return 0.3 if time < 4.0 else 0.01

    found = analysed(tmp_path, drive_on_line(lateral, duration=12.0)).metrics
    assert found["steady_cross_track_max"] == pytest.approx(0.01)
    assert found["cross_track_max"] == pytest.approx(0.3)


def test_commands_and_their_timing(tmp_path):
    found = analysed(tmp_path, drive_on_line(lambda _: 0.0)).metrics
    assert found["linear_effort"] == pytest.approx(0.25 * 20.0)
    assert found["angular_effort"] == pytest.approx(0.04 * 20.0)
    assert found["linear_variation"] == 0.0
    assert found["angular_variation"] == pytest.approx(0.4 * 2000)
    assert found["command_rate"] == pytest.approx(100.0)
    assert found["command_jitter"] == pytest.approx(0.0, abs=1e-9)
    assert found["latency_p50"] == pytest.approx(0.003)
    assert found["latency_p99"] == pytest.approx(0.003)


def test_jitter_and_latency_of_late_commands(tmp_path):
    """Periods of 8 and 12 ms in turns: 2 ms; every tenth answer is late by 20 ms."""
    messages = [("/path", 0, LINE)]
    for step in range(1001):
        stamp = SECOND + step * SECOND // 100 + (step % 2) * 2_000_000
        messages.append(("/odom", stamp, odometry(stamp, 0.005 * step, 0.0, 0.0)))
        late = 20_000_000 if step % 10 == 0 else 1_000_000
        messages.append(("/cmd_vel", stamp + late, twist_stamped(stamp, 0.5, 0.0)))
    found = analysed(tmp_path, sorted(messages, key=lambda item: item[1])).metrics
    assert found["command_jitter"] == pytest.approx(0.002)
    assert found["command_period_max"] == pytest.approx(0.012)
    assert found["latency_p50"] == pytest.approx(0.001)
    assert found["latency_p99"] == pytest.approx(0.020)


def test_latency_without_stamps_is_that_to_the_last_odometry(tmp_path):
    found = analysed(tmp_path, drive_on_line(lambda _: 0.0, commands=twist)).metrics
    assert found["latency_p50"] == pytest.approx(0.003)


def test_without_a_virtual_target_no_settling_time_is_known(tmp_path):
    found = analysed(tmp_path, drive_on_line(lambda time: 0.2 * math.exp(-time))).metrics
    assert math.isnan(found["settling_time"])
    assert found["approach_time"] == pytest.approx(math.log(20.0), abs=0.011)


def test_approach_and_overshoot():
    time = np.linspace(0.0, 20.0, 20001)
    found = approach(time, 0.4 * np.exp(-time))
    assert found == {"approach_time": pytest.approx(math.log(20.0), abs=2e-3), "overshoot": 0.0}
    # The first and largest swing to the other side is half a period later.
    found = approach(time, -0.4 * np.exp(-0.5 * time) * np.cos(np.pi * time))
    assert found["overshoot"] == pytest.approx(math.exp(-0.5), rel=0.02)
    assert math.isnan(approach(time, np.full(len(time), 0.3))["approach_time"])
    # A robot that begins on the path has nothing to approach, and noise overshoots nothing.
    for lateral, noise in ((0.001, 0.0), (0.02, 0.01)):
        found = approach(time, np.full(len(time), lateral), noise)
        assert all(math.isnan(value) for value in found.values())


def test_cost_beside_a_line_and_its_optimum(tmp_path):
    """0.1 m beside the path at the desired speed, the running cost is 0.01."""
    still = drive_on_line(lambda _: 0.1, duration=31.0, rate=20)
    messages = [
        ("/path_follower/configuration", 0, text("settings:\n  desired_speed: 0.5\n")),
        *[
            (topic, time, twist_stamped(time - 3_000_000, 0.5, 0.0) if "cmd" in topic else message)
            for topic, time, message in still
        ],
    ]
    found = analysed(tmp_path, messages)
    # The virtual target starts at the nearest place of a grid, up to 1 cm beside the robot.
    assert found.metrics["cost"] == pytest.approx(0.3, rel=1e-4)
    pytest.importorskip("casadi", reason="J* needs the extra 'optimum'")
    assert 0.0 < found.metrics["optimal_cost"] < 0.1
    assert found.metrics["cost_ratio"] == pytest.approx(
        0.3 / found.metrics["optimal_cost"], rel=1e-4
    )


def test_the_learners_numbers_and_states(tmp_path):
    found = analysed(tmp_path, learner_run())
    assert found.metrics["excitation_min"] == pytest.approx(0.25, abs=1e-3)
    # 0.2 exp(-t) m beside its target at 50 Hz
    assert found.metrics["settling_time"] == pytest.approx(math.log(4.0), abs=0.021)
    assert found.metrics["bellman_error_rms"] == pytest.approx(
        0.1 * math.sqrt((1.0 - math.exp(-24.0)) / 24.0), rel=0.02
    )


def test_settling_counts_from_the_first_command_even_if_the_first_errors_are_missing(tmp_path):
    run = learner_run()
    errors = [item for item in run if "tracking_error" in item[0]]
    late = [item for item in run if item not in errors[:25]]  # those of half a second
    found = analysed(tmp_path, late)
    assert found.metrics["settling_time"] == pytest.approx(math.log(4.0), abs=0.021)
    assert found.states == {
        "waiting": pytest.approx(2.0),
        "following": pytest.approx(6.0 + 4.0),
        "fault": pytest.approx(1.0),
    }
    assert [(event.kind, event.text) for event in found.events if event.kind != "path"] == [
        ("state", "waiting: no path"),
        ("state", "following"),
        ("parameter", "desired_speed: 0.5 → 0.4"),
        ("fault", "fault: no odometry"),
        ("state", "following"),
    ]
    assert {"weights", "cost", "bellman_error", "excitation"} <= set(found.charts.panels)
    shown = [line.name for line in found.charts.panels["weights"][0].lines if not line.background]
    assert sorted(shown) == sorted(f"w{index}" for index in range(4, 14))


def test_many_paths_hide_no_fault(tmp_path, monkeypatch):
    """As behind a planner that plans anew all the time, before the robot gets into trouble."""
    monkeypatch.setattr(events, "MOST_EVENTS", 60)  # so that a tenth of the paths are too many
    ahead = [(0.1 * index, 0.0) for index in range(3)]
    paths = [
        ("/path", SECOND + index * 41_000_000, path_message([*ahead, (1.0 + 0.01 * index, 0.0)]))
        for index in range(125)
    ]
    found = analysed(tmp_path, sorted([*learner_run(), *paths], key=lambda item: item[1]))
    kinds = [event.kind for event in found.events]
    assert len(kinds) == 60
    assert [kinds.count(kind) for kind in ("state", "fault", "parameter")] == [3, 1, 1]
    times = [event.time for event in found.events if event.kind == "path"]
    assert max(np.diff(times[1:])) < 0.2  # the first came long before
    assert times[-1] > 4.9
    left_out = 126 - (60 - 5)
    assert found.events_left_out in found.notes
    assert found.events_left_out.startswith(f"{left_out} of 126 path events are left out")


@pytest.mark.parametrize(
    ("duration", "expected"),
    [(20.0, 0.01 * math.sin(0.475 * math.pi)), (6.0, 0.5)],
    ids=["most of it on the path", "too short to tell"],
)
def test_the_colours_of_the_track_are_for_what_it_is_like_after_the_start(
    tmp_path, duration, expected
):
    def lateral(time: float) -> float:
        return 0.5 if time < 5.0 else 0.01 * math.sin(math.pi * time)

    track = analysed(tmp_path, drive_on_line(lateral, duration=duration)).charts.track
    assert track.color_limit == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize("late", [(), (7, 13), (3,)], ids=["even", "two late", "one late"])
@pytest.mark.parametrize("rate", [20, 50, 100])
def test_the_usual_period_is_one_bar(tmp_path, rate, late):
    """Stamps of a whole rate differ by rounding only, which must not make two bars of it."""
    messages = [("/path", 0, LINE)]
    for step in range(200):
        stamp = SECOND + step * SECOND // rate + (3_000_000 if step in late else 0)
        messages.append(("/odom", stamp, odometry(stamp, 0.5 * step / rate, 0.0, 0.0)))
        messages.append(("/cmd_vel", stamp, twist_stamped(stamp, 0.5, 0.0)))
    found = analysed(tmp_path, messages).charts.histograms["period"]
    assert found.counts.sum() == 199
    assert sorted(found.counts[found.counts > 0].tolist()) == sorted(
        [199 - 2 * len(late), *([len(late)] * 2 if late else [])]
    )
    place = int(found.counts.argmax())
    assert found.edges[place : place + 2].mean() == pytest.approx(1000.0 / rate)


def test_the_picture_of_a_histogram_shows_a_single_count(tmp_path):
    from matplotlib.figure import Figure

    from adp_path_follower.analysis import bag_pngs

    found, picture = analysed(tmp_path, drive_on_line(lambda _: 0.0)), Figure()
    bag_pngs._histogram([found], "period", picture)
    (axes,) = picture.axes
    assert axes.get_ylim()[0] < 1.0


def test_a_curve_has_one_colour_on_the_page_and_in_the_picture(tmp_path):
    pytest.importorskip("plotly", reason="the report needs the extra 'report'")
    from matplotlib.colors import to_hex
    from matplotlib.figure import Figure

    from adp_path_follower.analysis import bag_pngs
    from adp_path_follower.drawing import page_figures

    found = analysed(tmp_path, learner_run())
    traces = page_figures.page_figures([found])["weights"]["data"]
    curves = [
        (trace["name"], trace["line"]["color"].lower(), trace["line"]["dash"] == "dash")
        for trace in traces
        if trace.get("hoverinfo") != "skip"
    ]
    picture = Figure()
    bag_pngs._over_time([found], "weights", 2, picture)
    assert curves == [
        (line.get_label(), to_hex(line.get_color()), line.get_linestyle() == "--")
        for axes in picture.axes
        for line in axes.lines
        if not line.get_label().startswith("_")
    ]
    assert len(curves) == 20


def test_every_path_is_drawn_with_its_corners_and_its_gaps(tmp_path):
    """Forty paths of 20 cm beside each other, and an arc of 2 m about the origin."""
    stubs = [
        ("/path", SECOND + row, path_message([(0.0, float(row)), (0.2, float(row))]))
        for row in range(1, 41)
    ]
    angles = np.linspace(0.0, 0.5 * math.pi, 60)
    arc = path_message(np.column_stack([2.0 * np.cos(angles), 2.0 * np.sin(angles)]).tolist())
    messages = [*drive_on_line(lambda _: 0.0, duration=2.0), *stubs, ("/path", SECOND + 50, arc)]
    found = analysed(tmp_path, sorted(messages, key=lambda item: item[1])).charts.track.path
    pieces = np.split(found, np.flatnonzero(np.isnan(found[:, 0])))
    pieces = [piece[np.isfinite(piece[:, 0])] for piece in pieces]
    assert len(pieces) == 42
    for row, piece in enumerate(pieces[1:41], start=1):
        assert piece[[0, -1]] == pytest.approx(np.array([[0.0, row], [0.2, row]]), abs=1e-6)
    assert np.hypot(*pieces[41].T) == pytest.approx(np.full(len(pieces[41]), 2.0), abs=1e-3)
    assert len(pieces[41]) >= 12
    assert len(found) < 5000


def test_curves_have_a_gap_where_odometry_and_commands_had_one(tmp_path):
    """Two seconds are missing: a straight line over them would be a drive that nobody saw."""
    kept = [
        (topic, stamp, *message)
        for topic, stamp, *message in drive_on_line(lambda time: 0.1 * time)
        if not 8 * SECOND <= stamp < 10 * SECOND
    ]
    panels = analysed(tmp_path, kept).charts.panels
    for line in [panel.lines[0] for key in ("errors", "commands") for panel in panels[key]]:
        (gap,) = np.flatnonzero(np.isnan(line.values))
        assert line.time[gap + 1] - line.time[gap - 1] > 1.9


def test_a_number_has_no_exponent_where_people_write_none():
    assert [number(value, 3) for value in (1408.6, 0.0546, 12.0)] == ["1409", "0.0546", "12"]


def test_a_bag_of_another_controller_gets_the_tracking_figures(tmp_path):
    found = analysed(tmp_path, drive_on_line(lambda _: 0.05, commands=twist))
    assert set(found.charts.panels) == {"errors", "commands"}
    assert set(found.charts.histograms) == {"period", "latency"}
    assert found.metrics["cross_track_max"] == pytest.approx(0.05)
    assert math.isnan(found.metrics["cost"])


def test_time_stops_when_the_commands_do(tmp_path):
    """Before the first command that is not zero, and after the last one, nothing counts."""
    messages = [("/path", 0, LINE)]
    for step in range(301):
        stamp = SECOND + step * SECOND // 10
        moves = 100 <= step <= 200
        far = 0.1 if moves else 3.0
        messages.append(("/odom", stamp, odometry(stamp, 0.0, far, 0.0)))
        messages.append(("/cmd_vel", stamp, twist_stamped(stamp, 0.5 * moves, 0.0)))
    found = analysed(tmp_path, messages).metrics
    assert found["duration"] == pytest.approx(10.0)
    assert found["cross_track_max"] == pytest.approx(0.1)


@pytest.mark.parametrize("started", ["path comes late", "at once"])
def test_latency_of_repeated_odometry_is_that_to_the_last_one(tmp_path, started):
    """Lock-step repeats what was not answered, before there is a path for seconds."""
    messages = [("/path", 0, LINE)]
    for step in range(101):
        stamp = SECOND + step * SECOND // 100
        arrival = stamp + 4 * SECOND
        message = odometry(stamp, 0.005 * step, 0.0, 0.0)
        if step == 0 and started == "path comes late":
            messages += [("/odom", SECOND + n * SECOND // 10, message) for n in range(40)]
        messages.append(("/odom", arrival, message))
        # The answer, and the same again as the last words of a controller.
        answers = (0.002, 0.3) if step == 100 else (0.002,)
        for late in answers:
            command = twist_stamped(stamp, 0.5, 0.0)
            messages.append(("/cmd_vel", arrival + round(late * SECOND), command))
    found = analysed(tmp_path, sorted(messages, key=lambda item: item[1])).metrics
    assert found["latency_p50"] == pytest.approx(0.002)
    assert found["latency_p99"] == pytest.approx(0.002)


def test_a_clock_that_waits_for_the_commands_tells_no_latency(tmp_path):
    """In lock-step the recorder's simulated time goes on with the odometry only."""
    messages = [("/path", 0, LINE)]
    for step in range(1001):
        stamp = SECOND + step * SECOND // 100
        # As in a recorder that is kept waiting with a topic for a while.
        arrival = SECOND + min(1000, step + (140 if 300 < step < 400 else step % 2)) * SECOND // 100
        messages.append(("/odom", stamp, odometry(stamp, 0.005 * step, 0.0, 0.0)))
        messages.append(("/cmd_vel", arrival, twist_stamped(stamp, 0.5, 0.0)))
    found = analysed(tmp_path, sorted(messages, key=lambda item: item[1]))
    assert math.isnan(found.metrics["latency_p99"])
    assert "latency" not in found.charts.histograms
    assert any(note.startswith("no latency: the recorder's clock") for note in found.notes)


def test_evo_reads_the_trajectory(tmp_path):
    """Its path length is ours to 0.1 %."""
    file_interface = pytest.importorskip("evo.tools.file_interface", reason="evo is not installed")
    path = lissajous()
    frame = path.frame(np.linspace(0.0, 30.0, 3001)).pose.tolist()
    messages = [("/path", 0, path_message(path.points(0.05)[:, :2].tolist()))]
    for step, pose in enumerate(frame):
        stamp = 1_700_000_000 * SECOND + step * SECOND // 100
        messages.append(("/odom", stamp, odometry(stamp, *pose)))
    found = analysed(tmp_path, messages)
    trajectory = file_interface.read_tum_trajectory_file(str(tmp_path / "trajectory.tum"))
    assert trajectory.num_poses == 3001
    assert trajectory.path_length == pytest.approx(found.metrics["distance"], rel=1e-3)
    assert trajectory.path_length == pytest.approx(30.0, rel=1e-3)


@pytest.mark.parametrize(
    ("apart", "noise", "gain", "told"),
    [
        (0.0, 0.0, 1.0, []),
        (0.02, 0.0, 1.0, [7.8, 6.5]),
        (0.0, 0.005, 1.05, []),
        (0, 0, 0.7, [6.5, 4.55]),
    ],
)
def test_distances_that_the_velocity_contradicts_are_doubted(apart, noise, gain, told):
    """Two publishers of odometry, one ahead of the other, lengthen the track to and fro."""
    time = np.arange(391) / 30.0
    random = np.random.default_rng(0)
    poses = np.zeros((len(time), 3))
    poses[:, 0] = 0.5 * time + apart * (np.arange(len(time)) % 2)
    poses[:, :2] += noise * random.standard_normal((len(time), 2))
    speed = np.full(len(time), 0.5 * gain)
    motion = motion_of(time, poses, speed, np.zeros(len(time), bool))
    numbers = [float(text) for text in re.findall(r"([0-9.]+) m", " ".join(motion.doubts()))]
    assert numbers == pytest.approx(told, rel=0.01)


def test_the_figure_eight_is_not_left_at_its_crossing():
    path = lissajous()
    arc_length = np.linspace(0.0, 1.5 * path.length, 20_000)
    frame = path.frame(arc_length)
    offset = 0.2 * np.sin(0.5 * arc_length)
    heading = frame.pose[:, 2]
    poses = frame.pose.copy()
    poses[:, 0] -= offset * np.sin(heading)
    poses[:, 1] += offset * np.cos(heading)
    found = project(path, poses)
    assert found.arc_length - found.arc_length[0] == pytest.approx(arc_length, abs=1e-6)
    assert found.cross_track == pytest.approx(offset, abs=1e-9)
    assert np.abs(found.heading).max() < 1e-6


def test_a_robot_that_is_put_elsewhere_is_found_again():
    path = Path.from_points([(float(x), 0.0) for x in range(30)])
    x = np.concatenate([np.linspace(0.0, 2.0, 100), np.linspace(20.0, 22.0, 100)])
    found = project(path, np.column_stack([x, np.full(200, 0.1), np.zeros(200)]))
    assert found.arc_length == pytest.approx(x, abs=1e-9)
    assert found.cross_track == pytest.approx(np.full(200, 0.1))


@given(
    hnp.arrays(float, st.integers(1, 500), elements=st.floats(-1e9, 1e9) | st.just(math.nan)),
    st.integers(1, 40),
)
def test_decimation_keeps_every_peak(values, buckets):
    kept = extremes(values, buckets)
    assert len(kept) <= 2 * buckets + 2
    assert (np.diff(kept) > 0).all()
    assert kept[0] == 0
    assert kept[-1] == len(values) - 1
    if np.isfinite(values).any():
        assert np.nanmax(values[kept]) == np.nanmax(values)
        assert np.nanmin(values[kept]) == np.nanmin(values)
        # Not only the greatest of all: that of each stretch between values that are kept.
        width = -(-len(values) // buckets) if len(values) > 2 * buckets else 1
        for start in range(0, len(values), width):
            piece = values[start : start + width]
            chosen = values[kept[(kept >= start) & (kept < start + width)]]
            if np.isfinite(piece).any():
                assert np.nanmax(chosen) == np.nanmax(piece)
                assert np.nanmin(chosen) == np.nanmin(piece)
