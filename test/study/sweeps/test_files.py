"""SWEEP.yaml: what it asks for, and what is refused in one sentence."""

from __future__ import annotations

import itertools
import json
import math
import textwrap
from pathlib import Path as FilePath

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.files import read_csv_columns
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build, flatten, setting_fields
from adp_path_follower.resources import config_file
from adp_path_follower.study.simulation.simulate import read_starts
from adp_path_follower.study.sweeps.conditions import PathSource
from adp_path_follower.study.sweeps.ranges import Range
from adp_path_follower.study.sweeps.request import read_sweep, read_tuning
from adp_path_follower.study.sweeps.runs import run_part
from folders import ROOT

EXAMPLES = sorted((ROOT / "config" / "sweeps").glob("*.yaml"))
FIELDS = {field.name: field for field in setting_fields(Settings)}


def sweep_of(folder: FilePath, text: str):
    file = folder / "sweep.yaml"
    file.write_text(textwrap.dedent(text))
    return read_sweep(file)


def test_every_run_is_in_the_order_that_is_documented(tmp_path):
    sweep = sweep_of(
        tmp_path,
        """
        settings: {actor_gain: [1.0, 2.0], basis_degree: [2, 3]}
        starts: [[0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0]]
        paths: [line, "circle:0.5"]
        robots: {ideal: {}, noisy: {position_noise: 0.01}}
        noise_seeds: [4, 7]
        learning: frozen
        duration: 0.1
        """,
    )
    assert (sweep.combinations, sweep.runs) == (4, 4 * 2 * 2 * 2 * 3)
    rows = []
    for number in range(sweep.parts):
        columns = run_part(sweep, number)
        names = ("actor_gain", "basis_degree", "path", "robot", "noise_seed", "start_s")
        rows += zip(*(columns[name] for name in names), strict=True)
        assert columns["run"].tolist() == list(sweep.runs_of(number))
        expected = 3 * columns["noise_seed"] + columns["start"]
        assert columns["robot_seed"].tolist() == expected.tolist()
    assert rows == list(
        itertools.product(
            *([1.0, 2.0], [2, 3], ["line", "circle:0.5"], ["ideal", "noisy"], [4, 7]),
            [0.1, 0.2, 0.3],
        )
    )


@settings(max_examples=30)
@given(
    combinations=st.integers(1, 9),
    paths=st.integers(1, 2),
    seeds=st.integers(1, 60),
    starts=st.integers(1, 300),
)
def test_the_parts_hold_every_run_once(tmp_path_factory, combinations, paths, seeds, starts):
    folder = tmp_path_factory.mktemp("plan")
    sweep = sweep_of(
        folder,
        f"""
        settings: {{actor_gain: {[float(gain) for gain in range(1, combinations + 1)]}}}
        starts: {{random: {starts}}}
        paths: {["line", "circle:0.5"][:paths]}
        robots: {{noisy: {{position_noise: 0.1}}}}
        noise_seeds: {seeds}
        """,
    )
    runs = [sweep.runs_of(number) for number in range(sweep.parts)]
    assert list(itertools.chain(*runs)) == list(range(sweep.runs))
    assert max(map(len, runs)) <= 128


def test_the_sampled_points_fill_the_ranges(tmp_path):
    sweep = sweep_of(
        tmp_path,
        """
        settings:
          actor_gain: {low: 1.0, high: 100.0, log: true}
          sample_half_widths: {low: [0.2, 0.2, 0.2, 0.1], high: [1.2, 2.2, 3.2, 0.9]}
          sample_count: {low: 200, high: 203}
        samples: 64
        """,
    )
    values = [sweep.varied(number) for number in range(sweep.combinations)]
    gains = np.sort([np.log10(item["actor_gain"]) / 2.0 for item in values])
    # Sobol: each of 64 stretches of the range has one point.
    assert np.floor(64 * gains).tolist() == list(range(64))
    counts = [item["sample_count"] for item in values]
    assert [counts.count(number) for number in (200, 201, 202, 203)] == [16] * 4
    for number in (0, 63):
        widths = sweep.settings(number).learning.sample_half_widths
        assert widths == tuple(values[number][f"sample_half_widths[{place}]"] for place in range(4))
    again = read_sweep(tmp_path / "sweep.yaml")
    assert [again.varied(number) for number in range(64)] == values
    assert again.digest == sweep.digest


@given(share=st.floats(0.0, 1.0, exclude_max=True), log=st.booleans())
def test_a_value_of_a_range_is_in_it(share, log):
    for name, low, high in (("actor_gain", 0.3, 7.0), ("basis_degree", 2, 7)):
        value = Range(FIELDS[name], None, low, high, log).at(share)
        assert low <= value <= high
        assert type(value) is FIELDS[name].kind


def test_what_the_results_depend_on_changes_the_digest(tmp_path):
    (tmp_path / "path.csv").write_text("x,y\n0,0\n1,0\n2,0\n3,0\n")
    (tmp_path / "mine.yaml").write_text("path_follower: {ros__parameters: {actor_gain: 3.0}}")
    text = "params: mine.yaml\npaths: [path.csv]\nstarts: [[0, 0, 0]]\nduration: 5\n"
    digests = [sweep_of(tmp_path, text).digest]
    digests.append(sweep_of(tmp_path, text.replace("duration: 5", "duration: 6")).digest)
    (tmp_path / "path.csv").write_text("x,y\n0,0\n1,0\n2,0\n3,1\n")
    digests.append(sweep_of(tmp_path, text).digest)
    (tmp_path / "mine.yaml").write_text("path_follower: {ros__parameters: {actor_gain: 4.0}}")
    digests.append(sweep_of(tmp_path, text).digest)
    assert len(set(digests)) == 4
    assert sweep_of(tmp_path, "# a comment\n" + text).digest == digests[-1]
    # Entries that only change how results are shown do not.
    assert sweep_of(tmp_path, text + "objectives: [cross_track]\n").digest == digests[-1]


def test_shipped_parameters_have_names_as_for_the_commands(tmp_path):
    named = sweep_of(tmp_path, "params: paper\n")
    (tmp_path / "paper").mkdir()  # is no file
    assert sweep_of(tmp_path, "params: paper\n").digest == named.digest
    assert sweep_of(tmp_path, f"params: {config_file('paper.yaml')}\n").digest == named.digest
    assert sweep_of(tmp_path, "params: default\n").digest != named.digest


def test_the_optimum_is_that_of_the_reference_and_known_only_there(tmp_path):
    reference = json.loads((ROOT / "test" / "data" / "optimum.json").read_text())["forty_starts"]
    assert read_starts().tolist() == reference["e0"]
    free = "set: {min_linear_vel: -.inf, max_linear_vel: .inf, max_angular_vel: .inf}\n"
    conditions = sweep_of(tmp_path, free + "starts: forty").conditions
    for name in ("lissajous", "line", "circle:0.5", "circle:1"):
        key = name.replace(":", "").replace("circle1", "circle1.0")
        found = conditions.optimal_costs(conditions.settings, PathSource(name))
        assert found.tolist() == reference[key]["costs"]
    for changed in (
        "starts: forty",  # with the default limits
        free + "starts: [[0.1, 0.2, 0.3]]",
        free + "starts: forty\nstart_arc_length: 1.0",
        free + "starts: forty\nduration: 5.0",
        free.replace("}", ", state_cost: [2.0, 1.0, 1.0]}") + "starts: forty",
        free.replace("}", ", desired_speed: 0.6}") + "starts: forty",
        free.replace("}", ", max_linear_accel: 1.0}") + "starts: forty",
    ):
        other = sweep_of(tmp_path, changed).conditions
        found = other.optimal_costs(other.settings, PathSource("lissajous"))
        assert np.isnan(found).all(), changed
    assert np.isnan(conditions.optimal_costs(conditions.settings, PathSource("circle:0.7"))).all()


def test_starts_from_a_box_are_in_it_and_always_the_same(tmp_path):
    def starts(seed):
        text = f"starts: {{random: 500, box: [1.0, 0.5, 0.0], seed: {seed}}}"
        return sweep_of(tmp_path, text).conditions.starts

    found = starts(3)
    assert np.abs(found).max(axis=0) == pytest.approx([1.0, 0.5, 0.0], abs=0.02)
    assert found.min() < -0.9
    assert (found == starts(3)).all()
    assert (found != starts(4)).any()
    (tmp_path / "starts.csv").write_text("s,y,theta\n1,2,3\n")
    assert sweep_of(tmp_path, "starts: {file: starts.csv}").conditions.starts.tolist() == [
        [1.0, 2.0, 3.0]
    ]


@pytest.mark.parametrize("file", EXAMPLES, ids=lambda file: file.name)
def test_the_examples_can_be_read(file):
    text = file.read_text(encoding="utf-8")
    if "trials:" in text:
        assert read_tuning(file).search.trials > 0
    else:
        sweep = read_sweep(file)
        assert flatten(sweep.settings(sweep.combinations - 1)) != flatten(build(Settings, {}))


def test_twenty_thousand_runs_are_that_many():
    assert read_sweep(ROOT / "config" / "sweeps" / "twenty_thousand.yaml").runs == 20_000


def test_the_starts_file_of_the_package_has_an_optimum_for_each():
    data = ROOT / "adp_path_follower" / "data"
    columns = ("lissajous", "line", "circle:0.5", "circle:1.0")
    assert read_csv_columns(data / "forty_starts_optimum.csv", columns).shape == (40, 4)


BAD = {
    "settings: {actor_gian: [1.0]}": "settings: unknown setting 'actor_gian'; did you mean 'actor_",
    "setings: {}": "unknown entry 'setings'; did you mean 'settings'?",
    "settings: {actor_gain: {low: 2.0, high: 1.0}}": "'actor_gain' has an empty range: low is 2",
    "settings: {actor_gain: []}": "setting 'actor_gain' has an empty list",
    "settings: {actor_gain: 3.0}": "'actor_gain' is 3.0, but must be a list of values to try",
    "settings: {actor_gain: [1.0, fast]}": "'actor_gain' is 'fast', but must be a number",
    "settings: {actor_gain: [1.0, 1.0]}": "'actor_gain' lists a value twice",
    "settings: {actor_gain: {low: 1.0}}": "a range is {low: 0.1, high: 10.0}",
    "settings: {actor_gain: {low: 1.0, high: 2.0, lgo: true}}": "a range is {low: 0.1",
    "settings: {actor_gain: {low: 0.0, high: 1.0, log: true}}": "must be above 0",
    "settings: {actor_gain: {low: -1.0, high: 1.0}}": "'actor_gain' is -1.0, but must be",
    "settings: {actor_gain: {low: 1.0, high: 2.0}}": "so give the number of points",
    "settings: {critic: {low: 1.0, high: 2.0}}": "list the values to try",
    "settings: {learning: {low: false, high: true}}": "list the values to try",
    "settings: {max_linear_vel: {low: 1.0, high: .inf}}\nsamples: 4": "has an infinite range",
    "settings: {state_cost: {low: [1.0], high: 2.0}}\nsamples: 4": "but must be a list of numbers",
    "settings: {basis_degree: [8], sample_count: [100]}": (
        "basis_degree: 8, sample_count: 100 is not"
    ),
    "samples: 4": "'settings' has no range to sample",
    "settings: [1]": "'settings' is [1], but must be NAME: VALUE entries",
    "set: {actor_gain: -1.0}": "setting 'actor_gain' is -1.0",
    "set: {actor_gian: 1.0}": "unknown setting 'actor_gian'",
    "params: nowhere.yaml": "nowhere.yaml cannot be read",
    "params: papr": "unknown parameters 'papr'; did you mean 'paper'?",
    "params: 3": "'params' is 3, but must be a file name",
    "starts: fourty": "'starts' must be 'forty'",
    "starts: []": "'starts' must be 'forty'",
    "starts: [[0, 0]]": "'starts' must be 'forty'",
    "starts: [[0, 0, .nan]]": "finite",
    "starts: {random: 0}": "starts: setting 'random' is 0, but must be an integer, at least 1",
    "starts: {random: 5, box: [1.0, -1.0, 0.0]}": "'box' is [1.0, -1.0, 0.0]",
    "starts: {ramdom: 5}": "did you mean 'random'?",
    "starts: {file: nowhere.csv}": "nowhere.csv cannot be read",
    "paths: [spiral]": "path 'spiral': unknown path",
    "paths: [nowhere.csv]": "nowhere.csv cannot be read",
    "paths: [line, line]": "'paths' has a name twice",
    "paths: []": "'paths' is [], but must be a list of names",
    "robots: {bad: {fricton: 0.1}}": "robot 'bad': unknown setting 'fricton'",
    "robots: {bad: {seed: 1}}": "robot 'bad': remove its seed, and set noise_seeds",
    "robots: {bad: 3}": "'bad' is 3, but must be NAME: VALUE",
    "robots: {bad: {rate: 50.0}}": "'rate' is of the simulator node",
    "noise_seeds: 3": "no robot of 'robots' is noisy",
    "noise_seeds: -1": "'noise_seeds' is -1",
    "noise_seeds: 99999999999": "'noise_seeds' is 99999999999",
    "noise_seeds: [1, one]": "'noise_seeds' is [1, 'one']",
    "starts: {file: null}": "'file' is None, but must be a file name",
    "settings: {actor_gain: [1.0], actor_gain: [2.0]}": "line 1: 'actor_gain' is there twice",
    "duration: 0": "'duration' is 0, but must be a number, at least 0.1, at most 100000 [s]",
    "duration: 1e300": "'duration' is 1e+300",
    "rate: 1e5": "'rate' is 100000.0, but must be a number, at least 1, at most 10000 [Hz]",
    "duration: true": "'duration' is True",
    "rate: .inf": "'rate' is inf",
    "learning: hot": "'learning' is 'hot', but must be one of cold, warm, frozen",
    "start_arc_length: here": "'start_arc_length' is 'here', but must be a number",
    "objectives: [speed]": "'objectives' is ['speed'], but must be one of cost, worst_case",
    "- 1": "must hold NAME: VALUE entries",
    "settings: {actor_gain: [": "not YAML",
}


@pytest.mark.parametrize("text", BAD)
def test_what_cannot_be_is_refused_in_one_sentence(tmp_path, text):
    with pytest.raises(AdpError) as refusal:
        sweep_of(tmp_path, text)
    message = str(refusal.value)
    assert BAD[text] in message
    assert "\n" not in message
    assert str(tmp_path) in message


@given(
    content=st.dictionaries(
        st.sampled_from(["settings", "starts", "paths", "robots", "noise_seeds", "set", "params"]),
        st.recursive(
            st.none() | st.booleans() | st.integers(-5, 5) | st.floats() | st.text(max_size=4),
            lambda inner: (
                st.lists(inner, max_size=3)
                | st.dictionaries(
                    st.sampled_from(["actor_gain", "low", "high", "log", "random", "file"]), inner
                )
            ),
            max_leaves=6,
        ),
    )
)
@settings(max_examples=60)
def test_any_content_is_read_or_refused(tmp_path_factory, content):
    file = tmp_path_factory.mktemp("any") / "sweep.yaml"
    file.write_text(json.dumps(content) if content else "{}")
    message = ""
    try:
        assert math.isfinite(read_sweep(file).runs)
    except AdpError as error:
        message = str(error)
    assert not message or str(file.parent) in message
    assert "\n" not in message
