"""The `adp` command as users call it: results, and bad input in one sentence."""

from __future__ import annotations

import errno
import json
import math
import os
import re
import resource
import subprocess
import sys
from pathlib import Path as FilePath

import numpy as np
import pytest
from click.testing import CliRunner

from adp_path_follower.cli import main
from adp_path_follower.core.errors import FileError
from adp_path_follower.ros.runtime import entry
from commands import adp
from folders import CASES, CONFIG, DATA

OPTIMUM = json.loads((DATA / "optimum.json").read_text())
PAPER = str(CONFIG / "paper.yaml")


@pytest.mark.smoke
@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--version"], 0, "adp, version "),
        (["simulate", "--duration", "1"], 0, "cost"),
        (["simulate", "--path", "spiral"], 2, "unknown path 'spiral'"),
        (["simulate", "--speed", "1"], 2, "No such option"),
    ],
)
def test_a_process_of_its_own_says_the_same(tmp_path, arguments, code, words):
    done = subprocess.run(
        [sys.executable, "-m", "adp_path_follower.cli.main", *arguments],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        timeout=120,
        env={**os.environ, "COLUMNS": "100"},
    )
    here = adp(*arguments, cwd=tmp_path)
    assert done.returncode == here.returncode == code
    assert done.stdout == here.stdout
    assert words in done.stdout + done.stderr
    if code:  # usage, above it, names the program as it was called
        assert done.stderr.splitlines()[-1] == here.stderr.splitlines()[-1]


def test_what_the_operating_system_refuses_is_one_sentence(tmp_path):
    done = adp("simulate", "--duration", "0.1", "--json", "/dev/full", cwd=tmp_path)
    assert done.returncode == 2
    told = "adp: output /dev/full cannot be written: No space left on device"
    assert done.stderr.splitlines()[-1] == told


@pytest.fixture
def most_bytes():
    """Let no file grow above so many bytes, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("name", ["optima.png", "optima.svg"])
def test_no_half_of_a_picture_stays_on_a_full_disk(tmp_path, most_bytes, name):
    most_bytes(2000)
    done = adp("optimum", "--figure", name, cwd=tmp_path)
    most_bytes(resource.RLIM_INFINITY)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1] == f"adp: output {name} cannot be written: File too large"
    assert not list(tmp_path.iterdir())
    assert adp("optimum", "--figure", name, cwd=tmp_path).returncode == 0
    assert (tmp_path / name).stat().st_size > 2000


def test_help_teaches():
    overview = adp("--help")
    assert overview.returncode == 0
    assert "paper" in overview.stdout
    assert "theorem" in adp("paper", "--help").stdout
    for command in ("compare", "demo", "optimum", "simulate", "parameters"):
        assert command in overview.stdout
        text = adp(command, "--help")
        assert text.returncode == 0
        assert "--params" in text.stdout
        assert "--set" in text.stdout
    assert adp("--version").stdout.startswith("adp, version ")


@pytest.mark.parametrize("command", [[], *([name] for name in main.adp.list_commands(None))])
def test_help_fits_a_terminal_and_keeps_examples_as_lines(command):
    text = CliRunner().invoke(main.adp, [*command, "--help"], terminal_width=80).output
    lines = text.splitlines()
    assert max(map(len, lines)) <= 80
    assert "\\b" not in text
    # An example begins its line, or follows what it is for; click would fill lines with them.
    examples = [line for line in lines if re.search(r"\badp [a-z]+( --?\w| \w+_| >|$)", line)]
    assert all(line.count("adp ") == 1 for line in examples)
    assert examples or command == ["paper"]


def test_simulate_writes_the_documented_json_and_npz(tmp_path):
    done = adp(
        *("simulate", "--params", PAPER, "--duration", "5", "--path", "circle:-0.5"),
        *("--start", "-0.5", "0.25", "-0.5", "--start", "0.1", "0.2", "0.3"),
        *("--json", "runs.json", "--npz", "runs.npz"),
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    runs = json.loads((tmp_path / "runs.json").read_text())["runs"]
    assert [run["start"] for run in runs] == [[-0.5, 0.25, -0.5], [0.1, 0.2, 0.3]]
    for run in runs:
        assert len(run["final_error"]) == 3
        assert len(run["max_inputs"]) == 2
        assert len(run["critic_weights"]) == 9
        assert run["cost"] > 0.0
        assert run["excitation"] > 0.0
        assert run["settled"] in (True, False)
    arrays = np.load(tmp_path / "runs.npz", allow_pickle=False)
    assert arrays["error"].shape == (2, 501, 3)
    # The controls that the trajectory says were applied cost what the run says it cost.
    e, u = arrays["error"], arrays["modified_input"]
    rate = (e**2).sum(axis=2) + (u**2).sum(axis=2)
    total = 0.01 * (rate[:, :-1].sum(axis=1))
    assert total == pytest.approx([run["cost"] for run in runs], rel=0.03)


def test_starts_from_a_file_are_kept_in_order(tmp_path):
    starts = np.array(OPTIMUM["forty_starts"]["e0"])
    lines = ["s,y,theta", *(",".join(map(str, row)) for row in starts)]
    (tmp_path / "starts.csv").write_text("\n".join(lines) + "\n")
    done = adp(
        *("simulate", "--starts", "starts.csv", "--duration", "30", "--json", "runs.json"),
        *("--path", "line", "--rate", "50", "--learning", "frozen"),
        *("--set", "max_linear_vel=.inf", "--set", "min_linear_vel=-.inf"),
        *("--set", "max_angular_vel=.inf"),
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    runs = json.loads((tmp_path / "runs.json").read_text())["runs"]
    assert np.allclose([run["start"] for run in runs], starts)
    ratio = np.array([run["cost"] for run in runs]) / np.array(
        OPTIMUM["forty_starts"]["line"]["costs"]
    )
    speed = re.search(r"simulated 1200 s in ([\d.]+) s: (\d+) simulated seconds per", done.stderr)
    assert float(speed[2]) == pytest.approx(1200.0 / float(speed[1]), rel=0.3)
    # The default weights are the Riccati solution: never below the optimum, near it on most.
    assert ratio.min() > 1.0
    assert np.median(ratio) < 1.05


def test_settings_by_file_and_by_set_agree(tmp_path):
    (tmp_path / "mine.yaml").write_text(
        "path_follower:\n  ros__parameters:\n    use_sim_time: true\n    desired_speed: 0.3\n"
    )
    by_file = adp("simulate", "--params", "mine.yaml", "--duration", "2", cwd=tmp_path)
    by_set = adp("simulate", "--set", "desired_speed=0.3", "--duration", "2", cwd=tmp_path)
    plain = adp("simulate", "--duration", "2", cwd=tmp_path)
    assert by_file.stdout == by_set.stdout != plain.stdout


def test_the_simulated_robot_is_what_sim_set_says(tmp_path):
    def final_error(*arguments):
        file = tmp_path / "runs.json"
        done = adp(
            *("simulate", "--duration", "3", "--start", "0", "0", "0", "--path", "line"),
            *("--json", str(file), *arguments),
        )
        assert done.returncode == 0, done.stderr
        return np.abs(json.loads(file.read_text())["runs"][0]["final_error"])

    assert final_error().max() < 1e-9
    noisy = ("--sim-set", "position_noise=0.01")
    assert 0.002 < final_error(*noisy).max() < 0.1
    assert final_error(*noisy).tolist() == final_error(*noisy).tolist()
    assert (final_error(*noisy) != final_error(*noisy, "--sim-set", "seed=1")).any()
    (tmp_path / "push.yaml").write_text("faults: [{at: 2.8, for: 0.2, push: [0.0, 2.0, 0.0]}]")
    pushed = final_error("--sim-set", f"fault_script={tmp_path}/push.yaml")
    assert 0.25 < pushed[1] < 0.4


BAD_INPUT = [
    (["simulate", "--params", "missing.yaml"], "file missing.yaml cannot be read: No such file"),
    (["simulate", "--params", "empty"], "file empty is empty"),
    (["simulate", "--params", "binary"], "file binary is not text"),
    (["simulate", "--params", "list.yaml"], "list.yaml is no ROS parameter file"),
    (["simulate", "--params", "other.yaml"], "other.yaml has no parameters for 'path_follower'"),
    (["simulate", "--params", "broken.yaml"], "broken.yaml, line 3: not YAML"),
    (["simulate", "--params", "unknown.yaml"], "unknown setting 'speed'"),
    (["simulate", "--set", "max_linear_vel"], "'max_linear_vel' is not NAME=VALUE"),
    (["simulate", "--set", "desired_speed=fast"], "'desired_speed' is 'fast', but must be a numb"),
    (["simulate", "--set", "input_cost=[1.0, -1.0]"], "must be positive definite"),
    (["simulate", "--set", "basis=[oops"], "which is not YAML"),
    (["simulate", "--path", "spiral"], "unknown path 'spiral'"),
    (["simulate", "--path", "circle:0"], "circle has curvature '0'"),
    (["simulate", "--path", "circle:abc"], "circle has curvature 'abc'"),
    (["simulate", "--path", "missing.csv"], "file missing.csv cannot be read"),
    (["simulate", "--path", "header.csv"], "header.csv has no column 'y'"),
    (["simulate", "--path", "words.csv"], "file words.csv, line 3: 'one,two' is not 2 numbers"),
    (["simulate", "--path", "point.csv"], "path has 1 distinct points"),
    (["simulate", "--starts", "header.csv"], "has no column 's'"),
    (["simulate", "--start", "nan", "0", "0"], "starts must be finite"),
    (["simulate", "--path", "line", "--start-arc-length", "101"], "the path is 100.00 m long"),
    (["simulate", "--path", "line", "--start-arc-length", "-1"], "start_arc_length is -1 m"),
    (["simulate", "--duration", "-1"], "duration is -1.0 s"),
    (["simulate", "--json", "nowhere/runs.json"], "there is no directory nowhere"),
    (["simulate", "--sim-set", "friction=0.0"], "setting 'friction' is 0.0, but must be"),
    (["simulate", "--sim-set", "lockstep=true"], "'lockstep' is of the simulator node, which"),
    (["simulate", "--sim-set", "fault_script=bumps"], "'bumps' is neither a file nor one of"),
    (["simulate", "--sim-set", "fault_script=fault.yaml"], "entry 1: 'frition' is no parameter"),
    (["compare", "--sim-set", "fault_script=clock_stops"], "there are no messages here"),
    (["demo", "--sim-set", "fault_script=fault.yaml"], "did you mean 'friction'?"),
    (["demo", "--params", "missing.yaml"], "file missing.yaml cannot be read"),
    (["demo", "--out", "full"], "output full holds files already"),
    (["demo", "--out", "empty"], "output empty is a file"),
    (["paper", "--out", "full"], "output full holds files already"),
    (["simulate", "--json", "x", "--npz", "./x"], "output x is given twice"),
    (["optimum", "--horizon", "-1"], "horizon is -1.0 s"),
    (["optimum", "--horizon", "1e7"], "horizon is 10000000.0 s, but must be above 0 and at most"),
    (["optimum", "--figure", "x.txt"], "figure x.txt must end in .png,"),
    (["optimum", "--figure", "x"], "figure x must end in .png,"),
    (
        ["optimum", "--check", "--set", "max_angular_accel=1"],
        "--check is for ideal robots without limits of acceleration",
    ),
    (["compare", "--controllers", "adp,pid"], "unknown controller 'pid': choose from adp,"),
    (["compare", "--controllers", "", "--out", "new"], "unknown controller ''"),
    (["compare", "--start", "nan", "0", "0", "--out", "new"], "starts must be finite values"),
    (["compare", "--set", "max_linear_jerk=1", "--out", "new"], "knows no limits of jerk"),
    (["compare", "--unlimited", "--set", "max_linear_accel=1", "--out", "new"], "drive backwards"),
    (["compare", "--out", "full"], "output full holds files already"),
    (["compare", "--starts", "header.csv"], "has no column 's'"),
    (["compare", "--duration", "0"], "horizon is 0.0 s"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> FilePath:
    """Return a folder with files that are all wrong."""
    found = tmp_path_factory.mktemp("bad")
    (found / "empty").write_text("")
    (found / "binary").write_bytes(bytes(range(256)))
    (found / "list.yaml").write_text("- 1\n- 2\n")
    (found / "other.yaml").write_text("amcl:\n  ros__parameters:\n    x: 1\n")
    (found / "broken.yaml").write_text("path_follower:\n  ros__parameters: [\n")
    (found / "unknown.yaml").write_text("path_follower:\n  ros__parameters:\n    speed: 1.0\n")
    (found / "fault.yaml").write_text("faults: [{at: 1.0, frition: 0.1}]")
    (found / "header.csv").write_text("x,z\n1,2\n")
    (found / "words.csv").write_text("x,y\n1,2\none,two\n")
    (found / "point.csv").write_text("x,y\n1,2\n1,2\n")
    (found / "full").mkdir()
    (found / "full" / "file").write_text("mine")
    return found


@pytest.mark.parametrize(("arguments", "expected"), BAD_INPUT)
def test_bad_input_is_one_sentence_and_exit_code_2(folder, arguments, expected):
    done = adp(*arguments, cwd=folder)
    assert done.returncode == 2
    assert expected in done.stderr
    assert "Traceback" not in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert done.stdout == ""
    assert (folder / "full" / "file").read_text() == "mine"
    assert not (folder / "new").exists()


@pytest.mark.parametrize(
    ("command", "option", "name"),
    [
        ("simulate", "--json", "x.json"),
        ("simulate", "--npz", "x.npz"),
        ("optimum", "--json", "x.json"),
        ("optimum", "--npz", "x.npz"),
        ("optimum", "--figure", "x.png"),
    ],
)
def test_a_full_disk_is_one_sentence_below_the_result(tmp_path, command, option, name):
    (tmp_path / name).symlink_to("/dev/full")
    duration = ["--duration", "0.1"] if command == "simulate" else []
    done = adp(command, *duration, option, name, cwd=tmp_path)
    assert done.returncode == 2
    assert f"output {name} cannot be written: No space left on device" in done.stderr
    assert "Traceback" not in done.stderr
    assert "-0.500   0.250   -0.524" in done.stdout


def test_an_output_has_the_name_that_was_given(tmp_path):
    done = adp("simulate", "--duration", "0.1", "--npz", "trajectories", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert [file.name for file in tmp_path.iterdir()] == ["trajectories"]
    assert np.load(tmp_path / "trajectories")["error"].shape == (1, 11, 3)


def test_unfinished_costs_are_null_in_json(tmp_path):
    from adp_path_follower.cli.outputs import write_json

    write_json(tmp_path / "x.json", {"a": [math.nan, 1.0], "b": (math.inf, {"c": -math.inf})})
    assert json.loads((tmp_path / "x.json").read_text()) == {
        "a": [None, 1.0],
        "b": [None, {"c": None}],
    }


@pytest.mark.parametrize("node", ["controller", "sim_unicycle", "path_publisher", "recorder"])
def test_a_node_without_ros_says_what_is_missing(node):
    without = (
        f"import sys; sys.modules['rclpy'] = None; from {entry.__name__} import {node}; {node}()"
    )
    done = subprocess.run(
        [sys.executable, "-c", without], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 1
    assert done.stdout == ""
    assert re.fullmatch(
        rf"the node {node} needs (ROS 2|rclpy[.a-z]+): source a ROS 2 Jazzy installation, or "
        r"pip install 'adp_path_follower\[jazzy\]'\n",
        done.stderr,
    )


def test_json_for_a_dash_is_alone_on_standard_output(tmp_path):
    done = adp("simulate", "--duration", "0.1", "--json", "-", cwd=tmp_path)
    assert done.returncode == 0
    assert json.loads(done.stdout)["runs"][0]["failed"] is False
    assert "-0.500   0.250   -0.524" in done.stderr
    assert not list(tmp_path.iterdir())


def test_a_run_that_leaves_the_path_is_exit_code_1_unless_that_is_allowed(tmp_path):
    far = ("simulate", "--duration", "1", "--start", "0", "1e7", "0")
    done = adp(*far, cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr.endswith("adp: 1 of 1 runs left the path\n")
    allowed = adp(*far, "--allow-failures", "--report", "page.html", cwd=tmp_path)
    assert allowed.returncode == 0, allowed.stderr
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    for card in ('–</span><span class="detail">∫ eᵀQe + uᵀRu<', "1 of 1</span>"):
        assert f'<span class="number">{card}' in page
    assert re.search(r'<td class="value"[^>]*>left the path</td>', page)


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (["analyse", "x"], "did you mean 'analyze'?"),
        (["simulate", "--path", "lissajou"], "did you mean 'lissajous'?"),
        (["simulate", "--path", "circl:0.5"], "did you mean 'circle:0.5'?"),
        (["simulate", "--parms", "x"], "--params"),
    ],
)
def test_who_mistypes_a_name_is_told_the_right_one(tmp_path, arguments, hint):
    done = adp(*arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert hint in done.stderr


def test_a_wrong_key_of_a_parameter_file_is_named_with_its_line(tmp_path):
    file = tmp_path / "robot.yaml"
    file.write_text("/**:\n  ros__parameters:\n    desired_speed: 0.5\n    max_liner_vel: 1.0\n")
    done = adp("simulate", "--params", "robot.yaml", cwd=tmp_path)
    assert done.returncode == 2
    assert "robot.yaml, line 4: " in done.stderr
    assert "max_linear_vel" in done.stderr


def test_an_output_that_does_not_fit_leaves_what_was_there(tmp_path, monkeypatch):
    from adp_path_follower.cli.outputs import write_json
    from adp_path_follower.core import files

    file = tmp_path / "x.json"
    write_json(file, {"a": 1})

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(FileError, match="No space left on device"):
        write_json(file, {"a": 2})
    assert json.loads(file.read_text()) == {"a": 1}
    assert [item.name for item in tmp_path.iterdir()] == ["x.json"]


def test_simulate_drives_turns_on_the_spot_and_to_the_heading_at_the_goal(tmp_path):
    turns = ["--path", str(CASES / "turn_on_the_spot.csv"), "--start", "0", "0", "0"]
    reversing = ["--set", "allow_reversing=true", "--set", "min_linear_vel=-0.3"]
    done = adp("simulate", *turns, *reversing, "--json", "runs.json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (run,) = json.loads((tmp_path / "runs.json").read_text())["runs"]
    assert run["reversed_for"] == 0.0
    assert run["goal_time"] < 15.0
    np.testing.assert_allclose(run["final_pose"][:2], 0.0, atol=0.06)
    assert abs(math.remainder(run["final_pose"][2] - math.pi, math.tau)) < 0.1
    goal = ["--path", str(CASES / "goal_yaw.csv"), "--start", "0", "0", "0"]
    done = adp("simulate", *goal, "--json", "runs.json", cwd=tmp_path)
    (run,) = json.loads((tmp_path / "runs.json").read_text())["runs"]
    assert run["final_pose"][2] == pytest.approx(2.0, abs=0.1)
    refused = adp("simulate", *goal, "--npz", "runs.npz", cwd=tmp_path)
    assert refused.returncode == 2
    assert "has turns on the spot or is driven backwards" in refused.stderr
