"""`adp analyze`: numbers against closed forms, and files that other tools read."""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
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
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from adp_path_follower.analysis.bag_analysis import BagAnalysis, analyse_bag
from adp_path_follower.analysis.bag_metrics import (
    METRIC_NAMES,
    METRICS,
    parse_requirement,
    settling,
)
from adp_path_follower.analysis.decimation import extremes
from adp_path_follower.analysis.projection import project
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.path import Path as FollowedPath
from adp_path_follower.core.path_library import lissajous

pytest.importorskip("plotly", reason="the report needs the extra 'report'")

ROOT = Path(__file__).parents[1]


def adp(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "adp_path_follower.cli.main", "analyze", *arguments],
        capture_output=True,
        text=True,
        cwd=cwd,
        timeout=120,
        env={**os.environ, "COLUMNS": "100"},
    )


def analysed(folder: Path, messages, name: str = "bag") -> BagAnalysis:
    return analyse_bag(write_bag(folder / name, messages), {}, 1, folder / "trajectory.tum")


# Numbers


def test_cross_track_of_a_sine(tmp_path):
    """A sine of amplitude A: RMS A/√2, mean 2A/π, 95 % below A sin(0.95 π/2)."""
    amplitude = 0.1
    found = analysed(
        tmp_path, drive_on_line(lambda time: amplitude * math.sin(math.pi * time), heading=0.05)
    ).metrics
    assert found["duration"] == pytest.approx(20.0)
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
    assert found["path_covered"] == pytest.approx(10.0, abs=1e-6)


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


def test_settling_and_overshoot():
    time = np.linspace(0.0, 20.0, 20001)
    found = settling(time, 0.4 * np.exp(-time))
    assert found == {"settling_time": pytest.approx(math.log(20.0), abs=2e-3), "overshoot": 0.0}
    # The first and largest swing to the other side is half a period later.
    found = settling(time, -0.4 * np.exp(-0.5 * time) * np.cos(np.pi * time))
    assert found["overshoot"] == pytest.approx(math.exp(-0.5), rel=0.02)
    assert math.isnan(settling(time, np.full(len(time), 0.3))["settling_time"])
    assert settling(time, np.full(len(time), 0.001))["settling_time"] == 0.0


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
    assert found.metrics["bellman_error_rms"] == pytest.approx(
        0.1 * math.sqrt((1.0 - math.exp(-24.0)) / 24.0), rel=0.02
    )
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


# Projection


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
    path = FollowedPath.from_points([(float(x), 0.0) for x in range(30)])
    x = np.concatenate([np.linspace(0.0, 2.0, 100), np.linspace(20.0, 22.0, 100)])
    found = project(path, np.column_stack([x, np.full(200, 0.1), np.zeros(200)]))
    assert found.arc_length == pytest.approx(x, abs=1e-9)
    assert found.cross_track == pytest.approx(np.full(200, 0.1))


# Decimation


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


# Requirements


@pytest.mark.parametrize(
    ("requirement", "met"),
    [
        ("cross_track_rms<0.02", True),
        ("cross_track_rms <= 0.01", True),
        ("cross_track_rms<0.01", False),
        ("command_rate>99", True),
        ("cost<1", False),  # not known
        ("time_in_state.fault<=0", True),
        ("time_in_state.following>=3", False),
    ],
)
def test_requirements(requirement, met):
    values = {"cross_track_rms": 0.01, "command_rate": 100.0, "cost": math.nan}
    assert parse_requirement(requirement).met(values) is met


@pytest.mark.parametrize(
    ("requirement", "message"),
    [
        ("cross_track_rms", "is not NAME<LIMIT"),
        ("crosstrack<1", "names no metric: there are duration, "),
        ("cross_track_rms<small", "has the limit 'small', which is no number"),
        ("cross_track_rms<nan", "which is no number"),
    ],
)
def test_requirements_that_make_no_sense(requirement, message):
    with pytest.raises(AdpError, match=message):
        parse_requirement(requirement)


# The command


@pytest.fixture(scope="module")
def reported(tmp_path_factory) -> tuple[Path, subprocess.CompletedProcess[str]]:
    """Return the output of an analysis of two bags with hostile strings."""
    folder = tmp_path_factory.mktemp("reported")
    write_bag(folder / "mine", learner_run())
    write_bag(folder / "other", drive_on_line(lambda _: 0.05, commands=twist))
    done = adp(
        *("mine", "other", "--out", "out"),
        *("--require", "cross_track_rms<0.06", "--require", "cross_track_max<0.1"),
        cwd=folder,
    )
    return folder / "out", done


def test_a_missed_requirement_is_exit_code_1(reported):
    directory, done = reported
    assert done.returncode == 1, done.stderr
    assert "required cross_track_max<0.1 is not met by mine: cross_track_max is 0.2" in done.stderr
    assert "not met by other" not in done.stderr
    content = json.loads((directory / "metrics.json").read_text())
    assert content["requirements"] == [
        {"text": "cross_track_rms<0.06", "met": [True, True]},
        {"text": "cross_track_max<0.1", "met": [False, True]},
    ]


def test_metrics_json_and_figures(reported):
    directory, _ = reported
    content = json.loads((directory / "metrics.json").read_text())
    assert [bag["name"] for bag in content["bags"]] == ["mine", "other"]
    for bag in content["bags"]:
        assert tuple(bag["metrics"]) == METRIC_NAMES
    assert content["bags"][1]["metrics"]["cost"] is None
    assert {file.name for file in (directory / "figures").iterdir()} >= {
        *("track.png", "errors.png", "commands.png", "weights.png", "bellman_error.png"),
        *("excitation.png", "cost.png", "period.png", "latency.png"),
    }


def test_the_page_needs_no_network_and_marks_the_best(reported):
    directory, _ = reported
    page = (directory / "report.html").read_text(encoding="utf-8")
    assert len(page.encode()) < 15_000_000
    without_plotly = re.sub(r"<script nonce=\"\w+\">.*?</script>", "", page, flags=re.DOTALL)
    assert not re.search(r"(src|href)=[\"']?(https?:)?//", without_plotly)
    assert "default-src 'none'" in page
    row = re.search(r"<code>cross_track_max</code>.*?</tr>", page, re.DOTALL).group()
    assert re.search(r"best\">0.05 <span title=\"best\">★", row)


def test_every_metric_is_documented():
    page = (ROOT / "docs" / "analysis.md").read_text(encoding="utf-8")
    for metric in METRICS:
        assert f"| `{metric.name}` | {metric.unit} | {metric.meaning} |" in page


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


def test_names_that_look_like_tags_stay_text(tmp_path):
    """ROS has no such names, but a file may."""
    attack = "</script><script>alert(1)</script><img src=x onerror=alert(2)>"
    messages = [*learner_run(hostile=attack), (f"/{attack}", 0, text("x"))]
    write_bag(tmp_path / "bag", sorted(messages, key=lambda item: item[1]))
    (tmp_path / "bag").rename(tmp_path / "<script>alert(3)<")
    done = adp("<script>alert(3)<", "--out", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "alert(1)" in page
    for tag in ("<script>alert", "<img src=x"):
        assert tag not in page


BAD_INPUT = [
    (["missing"], "bag {folder}/missing does not exist"),
    (["empty"], "bag {folder}/empty cannot be read"),
    (["good", "--odom", "/nowhere"], "has no topic /nowhere; of a type that fits are: /odom"),
    (["good", "--cmd", "/odom"], "topic /odom of bag {folder}/good has the type nav_msgs"),
    (["good", "--require", "speed<1"], "--require 'speed<1' names no metric"),
    (["good", "--out", "good"], "output good holds files already"),
    (["pathless"], "has no path: name a topic of nav_msgs/msg/Path by --path"),
    (["lost"], "has no odometry: name a topic of nav_msgs/msg/Odometry by --odom"),
    (["point"], "no path that can be followed: path has 1 distinct points"),
    (["nan"], "has no odometry that is finite"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Return a folder with bags that cannot be analysed."""
    found = tmp_path_factory.mktemp("bad")
    run = drive_on_line(lambda _: 0.0, duration=1.0)
    write_bag(found / "good", run)
    write_bag(found / "pathless", run[1:])
    write_bag(found / "lost", run[:1])
    write_bag(found / "point", [("/path", 0, path_message([(1.0, 2.0)])), *run[1:]])
    write_bag(found / "nan", [run[0], ("/odom", 1, odometry(1, math.nan, 0.0, 0.0))])
    (found / "empty").mkdir()
    return found


@pytest.mark.parametrize(("arguments", "expected"), BAD_INPUT)
def test_bad_input_is_one_sentence_and_exit_code_2(folder, arguments, expected):
    done = adp(*arguments, *([] if "--out" in arguments else ["--out", "out"]), cwd=folder)
    assert done.returncode == 2
    assert expected.format(folder=folder) in done.stderr
    assert "Traceback" not in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_help_teaches(tmp_path):
    done = adp("--help", cwd=tmp_path)
    assert done.returncode == 0
    for word in ("--odom", "--cmd", "--path", "--require", "trajectory.tum", "Exit code 1"):
        assert word in done.stdout
