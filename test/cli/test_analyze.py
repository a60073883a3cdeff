"""`adp analyze`: the command, and files that other tools read."""

from __future__ import annotations

import errno
import json
import math
import os
import re
from pathlib import Path as FilePath

import pytest
from pages import page_data

from adp_path_follower.analysis.metrics import METRIC_NAMES, parse_requirement, with_states
from adp_path_follower.core.errors import AdpError
from bag_messages import (
    SECOND,
    array,
    drive_on_line,
    error_stamped,
    learner_run,
    number,
    odometry,
    path_message,
    pose_stamped,
    text,
    twist,
    write_bag,
)
from commands import Done, adp

pytest.importorskip("plotly", reason="the report needs the extra 'report'")


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
        ("time_in_state.goal reached<=0", True),
        ("time_in_state.following>=3", False),
    ],
)
def test_requirements(requirement, met):
    values = {"cross_track_rms": 0.01, "command_rate": 100.0, "cost": math.nan}
    found = with_states(values, {"following": 2.0})
    assert parse_requirement(requirement).met(found) is met


def test_of_a_bag_that_tells_no_states_no_time_in_them_is_known():
    for requirement in ("time_in_state.fault<=0", "time_in_state.fault>=0"):
        assert not parse_requirement(requirement).met(with_states({}, {}))


@pytest.mark.parametrize(
    ("requirement", "message"),
    [
        ("cross_track_rms", "is not NAME<LIMIT"),
        ("crosstrack<1", "names no metric: there are duration, "),
        ("time_in_state.faults<=0", "names no state of the controller: there are inactive, "),
        ("cross_track_rms<small", "has the limit 'small', which is no number"),
        ("cross_track_rms<nan", "which is no number"),
    ],
)
def test_requirements_that_make_no_sense(requirement, message):
    with pytest.raises(AdpError, match=message):
        parse_requirement(requirement)


# The command


@pytest.fixture(scope="module")
def reported(tmp_path_factory) -> tuple[FilePath, Done]:
    """Return the output of an analysis of two bags with hostile strings."""
    folder = tmp_path_factory.mktemp("reported")
    write_bag(folder / "mine", learner_run())
    write_bag(folder / "other", drive_on_line(lambda _: 0.05, commands=twist))
    done = adp(
        "analyze",
        *("mine", "other", "--out", "out"),
        *("--require", "cross_track_rms<0.06", "--require", "cross_track_max<0.1"),
        *("--require", "time_in_state.inactive<=0"),
        cwd=folder,
    )
    return folder / "out", done


@pytest.mark.smoke
def test_a_missed_requirement_is_exit_code_1(reported):
    directory, done = reported
    assert done.returncode == 1, done.stderr
    assert "required cross_track_max<0.1 is not met by mine: cross_track_max is 0.2" in done.stderr
    unknown = "time_in_state.inactive<=0 is not met by other: time_in_state.inactive is not known"
    assert f"required {unknown}" in done.stderr
    assert done.stderr.count("not met by") == 2
    content = json.loads((directory / "metrics.json").read_text())
    assert content["requirements"] == [
        {"text": "cross_track_rms<0.06", "met": [True, True]},
        {"text": "cross_track_max<0.1", "met": [False, True]},
        {"text": "time_in_state.inactive<=0", "met": [True, False]},
    ]


def test_metrics_json_and_figures(reported):
    directory, _ = reported
    content = json.loads((directory / "metrics.json").read_text())
    assert [bag["name"] for bag in content["bags"]] == ["mine", "other"]
    for bag in content["bags"]:
        assert tuple(bag["metrics"]) == METRIC_NAMES
    assert content["bags"][1]["metrics"]["cost"] is None
    assert {file.name for file in (directory / "figures").iterdir()} == {
        *("track.png", "errors.png", "commands.png", "weights.png", "bellman_error.png"),
        *("excitation.png", "cost.png", "period.png", "latency.png"),
        "events.png",
    }


def test_the_page_needs_no_network_and_marks_the_best(reported):
    directory, _ = reported
    page = (directory / "report.html").read_text(encoding="utf-8")
    assert len(page.encode()) < 15_000_000
    without_plotly = re.sub(r"<script nonce=\"\w+\">.*?</script>", "", page, flags=re.DOTALL)
    assert not re.search(r"(src|href)=[\"']?(https?:)?//", without_plotly)
    assert "default-src 'none'" in page
    row = re.search(r"<code>cross_<wbr>track_<wbr>max</code>.*?</tr>", page, re.DOTALL).group()
    assert re.search(r"best\">0.05 <span title=\"best\">★", row)


def test_bags_of_the_same_name_are_told_apart(tmp_path):
    """As those of two demonstrations, which are both called "bag"."""
    for run, offset in (("slow", 0.05), ("fast", 0.01)):
        write_bag(tmp_path / run / "bag", drive_on_line(lambda _, far=offset: far, duration=2.0))
    required = ("--require", "cross_track_max<0.02")
    done = adp("analyze", "slow/bag", "fast/bag", "--out", "out", *required, cwd=tmp_path)
    assert "not met by slow/bag: " in done.stderr
    assert done.stdout.splitlines()[0].split() == ["slow/bag", "fast/bag"]
    content = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert [bag["name"] for bag in content["bags"]] == ["slow/bag", "fast/bag"]
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    groups = re.findall(r'"legendgroup":"([^"]*)"', page_data(page))
    assert len(set(groups)) == 2
    assert groups.count(groups[0]) == len(groups) / 2


@pytest.mark.parametrize(
    ("bags", "names"),
    [
        (["/a/bag"], ["bag"]),
        (["/a/run", "/a/bag", "/b/bag"], ["run", "a/bag", "b/bag"]),
        (["/a/x/bag", "/b/x/bag", "/b/y/bag"], ["a/x/bag", "b/x/bag", "y/bag"]),
        (["/x/bag", "/a/x/bag"], ["/x/bag", "a/x/bag"]),
        (["/a/bag", "/a/bag", "/b/bag"], ["a/bag", "a/bag (2)", "b/bag"]),
    ],
)
def test_names_are_as_long_as_they_must_be(bags, names):
    from adp_path_follower.analysis.bag_analysis import names_of

    assert names_of([FilePath(bag) for bag in bags]) == names


def test_names_that_look_like_tags_stay_text(tmp_path):
    """ROS has no such names, but a file may."""
    attack = "</script><script>alert(1)</script><img src=x onerror=alert(2)>"
    messages = [*learner_run(hostile=attack), (f"/{attack}", 0, text("x"))]
    write_bag(tmp_path / "bag", sorted(messages, key=lambda item: item[1]))
    (tmp_path / "bag").rename(tmp_path / "<script>alert(3)<")
    done = adp("analyze", "<script>alert(3)<", "--out", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "alert(1)" in page
    for tag in ("<script>alert", "<img src=x"):
        assert tag not in page


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [-1e308, math.inf])
def test_damaged_numbers_of_the_learner_raise_no_warning(tmp_path, value):
    """A damaged message may hold anything; squares and figures have their limits."""
    from adp_path_follower.analysis.bag_analysis import analyse_bag
    from adp_path_follower.analysis.bag_page import write_report
    from adp_path_follower.analysis.bag_pngs import draw_bags

    stamp, node = 5 * SECOND, "/path_follower"
    damaged = [
        *((f"{node}/{name}", number(value)) for name in ("cost", "bellman_error", "excitation")),
        *((f"{node}/{name}_weights", array([value] * 14)) for name in ("critic", "actor")),
        (f"{node}/target", pose_stamped(stamp, value, value, 0.0)),
        (f"{node}/tracking_error", error_stamped(stamp, value, value, value)),
    ]
    messages = [*learner_run(), *((topic, stamp, message) for topic, message in damaged)]
    bag = write_bag(tmp_path / "bag", sorted(messages, key=lambda item: item[1]))
    found = analyse_bag(bag, {}, 1, tmp_path / "trajectory.tum")
    assert found.metrics["cross_track_max"] == pytest.approx(0.2)
    draw_bags([found], tmp_path / "figures")
    write_report([found], [], tmp_path / "report.html")


BAD_INPUT = [
    (["missing"], "bag {folder}/missing does not exist"),
    (["empty"], "directory {folder}/empty holds no bag: neither metadata.yaml nor .mcap"),
    (["torn"], "bag {folder}/torn has no metadata.yaml: `adp recover` makes a bag of MCAP files"),
    (["run.mcap.zstd"], "run.mcap.zstd is packed: give the directory of its bag, or unpack it"),
    (["run.csv"], "run.csv is no bag of ROS 2: give a directory, or one .mcap or .db3 file"),
    (["good", "--odom", "/nowhere"], "has no topic /nowhere; of a type that fits are: /odom"),
    (["good", "--cmd", "/odom"], "topic /odom of bag {folder}/good has the type nav_msgs"),
    (["good", "--require", "speed<1"], "--require 'speed<1' names no metric"),
    (["good", "--out", "good"], "output good holds files already"),
    (["good", "--out", "/proc/report"], "output /proc/report cannot be made: No such file"),
    (["good", "--out", "long" * 75], "cannot be made: File name too long"),
    (["pathless"], "has no path: name a topic of nav_msgs/msg/Path by --path"),
    (["lost"], "has no odometry: name a topic of nav_msgs/msg/Odometry by --odom"),
    (["point"], "no path that can be followed: path has 1 distinct points"),
    (["nan"], "has no odometry that is finite"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> FilePath:
    """Return a folder with bags that cannot be analysed."""
    found = tmp_path_factory.mktemp("bad")
    run = drive_on_line(lambda _: 0.0, duration=1.0)
    write_bag(found / "good", run)
    write_bag(found / "pathless", run[1:])
    write_bag(found / "lost", run[:1])
    write_bag(found / "point", [("/path", 0, path_message([(1.0, 2.0)])), *run[1:]])
    write_bag(found / "nan", [run[0], ("/odom", 1, odometry(1, math.nan, 0.0, 0.0))])
    (found / "empty").mkdir()
    write_bag(found / "torn", run)
    (found / "torn" / "metadata.yaml").unlink()
    for name in ("run.mcap.zstd", "run.csv"):
        (found / name).write_bytes(b"something")
    return found


@pytest.mark.parametrize(("arguments", "expected"), BAD_INPUT)
def test_bad_input_is_one_sentence_and_exit_code_2(folder, arguments, expected):
    done = adp(
        "analyze", *arguments, *([] if "--out" in arguments else ["--out", "out"]), cwd=folder
    )
    assert done.returncode == 2
    assert expected.format(folder=folder) in done.stderr
    assert "Traceback" not in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not (folder / "out").exists()


def test_a_full_disk_is_one_sentence(folder, tmp_path, monkeypatch):
    from adp_path_follower.analysis import bag_page as report

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(report, "write_page", full)
    done = adp("analyze", str(folder / "good"), "--out", "out", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr == "adp: output out cannot be written: No space left on device\n"
    assert not list(tmp_path.iterdir())
    (tmp_path / "mine").mkdir()
    adp("analyze", str(folder / "good"), "--out", "mine", cwd=tmp_path)
    assert not list((tmp_path / "mine").iterdir())


def test_help_teaches(tmp_path):
    done = adp("analyze", "--help", cwd=tmp_path)
    assert done.returncode == 0
    for word in ("--odom", "--cmd", "--path", "--require", "trajectory.tum", "Exit code 1"):
        assert word in done.stdout
