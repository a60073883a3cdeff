"""`adp tune`: it finds what is best, refuses what cannot be, and goes on where it was."""

from __future__ import annotations

import dataclasses
import itertools
import json
import subprocess
import sys
import textwrap
from pathlib import Path as FilePath

import pytest

from commands import adp
from folders import CONFIG

optuna = pytest.importorskip("optuna", reason="the extra 'sweep' is not installed")

from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.core.settings.schema import build, flatten, setting_fields
from adp_path_follower.study.sweeps.ranges import Listed, Range, own_range
from adp_path_follower.study.sweeps.request import read_tuning, tuning_of_options
from adp_path_follower.study.sweeps.results import results, results_text, write_results
from adp_path_follower.study.sweeps.study import (
    open_study,
    refused,
    score_of,
    tried,
    tune,
)

PAPER = CONFIG / "paper.yaml"
QUICK = f"params: {PAPER}\nstarts: [[0.1, 0.1, 0.1]]\nlearning: frozen\nduration: 0.2\nrate: 50.0\n"
FIELDS = {field.name: field for field in setting_fields(Settings)}


class Inline:
    """Workers that do everything at once, here."""

    def begin(self, function, *arguments):
        """Return what the function makes of the arguments."""
        return function(*arguments)

    def result(self, future):
        """Return it."""
        return future


def tuning_of(folder: FilePath, text: str):
    file = folder / "tune.yaml"
    file.write_text(QUICK + textwrap.dedent(text))
    return read_tuning(file)


def study_of(folder: FilePath, tuning, shared=False):
    return open_study(tuning, f"sqlite:///{folder / 'study.db'}", shared)


def study_in_memory(tuning):
    """Return a study that no other command goes on with; a database takes most of the time."""
    return open_study(tuning, optuna.storages.InMemoryStorage(), shared=False)


def tuned(folder: FilePath, text: str):
    tuning = tuning_of(folder, text)
    study = study_in_memory(tuning)
    tune(study, tuning, Inline(), lambda fraction: None)
    return study, results(study, tuning)


def test_the_best_is_the_best_of_all_that_was_tried(tmp_path):
    study, found = tuned(
        tmp_path,
        """
        settings:
          target_gain: {low: 0.01, high: 2.0, log: true}
          input_cost: {low: [0.5, 0.5], high: [2.0, 2.0]}
        trials: 24
        """,
    )
    trials = tried(study)
    assert len(trials) == len(found.trials) == 24
    assert found.unstable == 0
    costs = [trial.values[0] for trial in trials]
    assert found.best is not None
    assert found.best.values[0] == min(costs) < max(costs)
    # The settings before are the first trial, so that nothing found is worse.
    before = {"target_gain": 0.1, "input_cost[0]": 1.0, "input_cost[1]": 1.0}
    assert trials[0].params == before
    assert trials[0].values[0] == found.before.objectives["cost"] >= min(costs)
    # The runs of a trial are judged by the cost before, not by the one that is tuned.
    assert found.before.objectives["cost"] == pytest.approx(score_of(trials[0]).median)
    assert {item.name for item in found.importance} == set(before)
    assert sum(found.importance.values()) == pytest.approx(1.0)


def test_the_file_that_is_written_gives_the_settings_again(tmp_path):
    study, found = tuned(
        tmp_path,
        """
        settings:
          target_gain: own
          sample_count: {low: 200, high: 400}
          critic: [gradient, least_squares]
          state_cost: [[1.0, 1.0, 1.0], [1.0, 2.0, 1.0]]
        objectives: [cost, effort]
        trials: 12
        """,
    )
    write_results(found, "mine", tmp_path)
    assert found.best is not None
    values = found.values(found.best)
    assert {type(value) for value in values.values()} == {float, int, str, tuple}
    loaded = load_settings(Settings, "path_follower", tmp_path / "best.yaml")
    before = flatten(load_settings(Settings, "path_follower", PAPER))
    assert flatten(loaded) == {**before, **values}
    # Two objectives give a front: no trial is better than one of it in both.
    front = [trial.values for trial in found.front]
    for point, trial in itertools.product(front, tried(study)):
        assert not all(mine < his for mine, his in zip(trial.values, point, strict=True))
    assert len(list((tmp_path / "front").glob("*.yaml"))) == (len(front) if len(front) > 1 else 0)


def test_no_file_of_a_larger_front_stays(tmp_path):
    _, found = tuned(
        tmp_path, "settings: {target_gain: own}\nobjectives: [cost, effort]\ntrials: 12"
    )
    mine = tmp_path / "front" / "mine.yaml"
    for count in (3, 2, 1):
        front = (found.front * 3)[:count]
        write_results(dataclasses.replace(found, front=front), "mine", tmp_path)
        mine.touch()
        names = {file.name for file in mine.parent.iterdir()} - {mine.name}
        assert names == {f"{number:03d}.yaml" for number in range(1, count + 1) if count > 1}


def test_a_file_that_cannot_be_written_is_named(tmp_path):
    _, found = tuned(tmp_path, "settings: {target_gain: own}\ntrials: 3")
    (tmp_path / "best.yaml").mkdir()
    with pytest.raises(AdpError, match=r"best.yaml cannot be written: Is a directory"):
        write_results(found, "mine", tmp_path)


def test_what_the_validation_refuses_is_never_run(tmp_path):
    study, found = tuned(
        tmp_path,
        "settings: {wide_region_levels: {low: 0.5, high: 12.0}}\ntrials: 10",
    )
    for trial in tried(study):
        levels = [trial.params[f"wide_region_levels[{place}]"] for place in (0, 1)]
        assert levels[0] < levels[1]
    assert len(tried(study)) == 10
    assert refused(study)
    assert all("wide_region_levels" in reason for reason in refused(study))
    assert sum(found.refused.values()) == len(refused(study))


def test_ranges_without_anything_that_is_allowed_end_in_a_sentence(tmp_path):
    tuning = tuning_of(
        tmp_path,
        "settings: {wide_region_levels: {low: [5.0, 1.0], high: [6.0, 2.0]}}\ntrials: 3",
    )
    with pytest.raises(AdpError, match="hardly any settings that are allowed: setting 'wide_reg"):
        tune(study_in_memory(tuning), tuning, Inline(), lambda fraction: None)


def test_what_is_unstable_is_no_candidate(tmp_path):
    """The paper's misprinted basis leaves the path, though it costs little at first."""
    text = f"""
        params: {PAPER}
        starts: [[-0.5, 0.25, -0.5]]
        learning: cold
        rate: 25.0
        duration: 7.0
        settings: {{basis: [paper_misprinted, paper], actor_gain: {{low: 4.0, high: 6.0}}}}
        trials: 8
        """
    file = tmp_path / "tune.yaml"
    file.write_text(textwrap.dedent(text))
    tuning = read_tuning(file)
    study = study_in_memory(tuning)
    tune(study, tuning, Inline(), lambda fraction: None)
    found = results(study, tuning)
    kinds = [tuning.values(trial.params)["basis"] for trial in tried(study)]
    bad = [score_of(trial).unstable for trial in tried(study)]
    assert [kind == "paper_misprinted" for kind in kinds] == [number > 0 for number in bad]
    assert 0 < found.unstable < 8
    assert found.best is not None
    assert found.values(found.best)["basis"] == "paper"
    assert f"{found.unstable} unstable in some run" in results_text(found)


def test_a_search_that_was_killed_goes_on(tmp_path):
    first = tuning_of(tmp_path, "settings: {target_gain: own}\ntrials: 3")
    study = study_of(tmp_path, first)
    tune(study, first, Inline(), lambda fraction: None)
    study.ask()  # a trial whose command is killed
    more = tuning_of(tmp_path, "settings: {target_gain: own}\ntrials: 6")
    assert more.digest == first.digest
    again = study_of(tmp_path, more)
    tune(again, more, Inline(), lambda fraction: None)
    states = [trial.state.name for trial in again.get_trials()]
    assert states == ["COMPLETE"] * 3 + ["FAIL"] + ["COMPLETE"] * 3
    gains = [trial.params["target_gain"] for trial in tried(again)]
    assert len(set(gains)) == 6  # nothing is tried twice


def test_the_same_seed_tries_the_same(tmp_path):
    gains = []
    for seed in (0, 0, 1):
        folder = tmp_path / str(len(gains))
        folder.mkdir()
        study, _ = tuned(
            folder, f"settings: {{target_gain: own}}\ntrials: 12\nat_once: 3\nseed: {seed}"
        )
        gains.append([trial.params["target_gain"] for trial in tried(study)])
    assert gains[0] == gains[1] != gains[2]


def test_several_commands_share_the_trials(tmp_path):
    tuning = tuning_of(tmp_path, "settings: {target_gain: own}\ntrials: 5")
    mine = study_of(tmp_path, tuning, shared=True)
    other = study_of(tmp_path, tuning, shared=True)
    pending = other.ask()
    tune(mine, tuning, Inline(), lambda fraction: None)
    assert len(tried(other)) == 5
    assert mine.get_trials()[pending.number].state.name == "RUNNING"  # the other's own


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("actor_gain", 5.0, [(0.5, 50.0, True)]),
        ("actor_gain", 0.0, [(0.0, 10_000.0, False)]),
        ("actor_gain", 5e3, [(500.0, 10_000.0, True)]),
        ("min_linear_vel", -0.2, [(-2.0, -0.02, False)]),
        ("basis_degree", 4, [(2, 8, True)]),
        ("input_cost", (1.0, 2.0), [(0.1, 10.0, True), (0.2, 20.0, True)]),
    ],
)
def test_a_setting_has_a_range_of_its_own(name, value, expected):
    found = own_range(FIELDS[name], value)
    assert all(isinstance(item, Range) for item in found)
    assert [(item.low, item.high, item.log) for item in found] == expected


def test_choices_are_all_tried_and_texts_have_no_range():
    (critic,) = own_range(FIELDS["critic"], "gradient")
    (learning,) = own_range(FIELDS["learning"], True)
    assert isinstance(critic, Listed)
    assert critic.values == ("least_squares", "gradient")
    assert isinstance(learning, Listed)
    assert learning.values == (False, True)
    for name in ("weights_file", "max_linear_vel"):
        with pytest.raises(AdpError, match=name):
            own_range(FIELDS[name], flatten(load_settings(Settings, "path_follower", PAPER))[name])


def test_without_a_file_the_learner_that_is_there_is_tuned():
    paper = tuning_of_options(PAPER, [], [], [])
    assert [item.name for item in paper.variations] == [
        *("critic_gain_measured", "critic_gain_sampled", "actor_gain"),
        *(f"sample_half_widths[{place}]" for place in range(4)),
    ]
    assert len(paper.conditions.starts) == 40
    assert paper.objectives == ("cost",)
    default = tuning_of_options(None, ["actor_gain=3.0"], ["actor_gain", "frame"], ["effort"])
    assert [item.name for item in default.variations] == ["actor_gain", "frame"]
    assert default.variations[0].low == pytest.approx(0.3)
    assert default.conditions.settings == build(Settings, {"actor_gain": 3.0})


BAD = {
    "settings: {actor_gian: own}": "did you mean 'actor_gain'?",
    "settings: {weights_file: own}": "is a text: list the values to try",
    "settings: {max_linear_vel: own}": "has no range of its own",
    "settings: {actor_gain: {low: 3.0, high: 1.0}}": "has an empty range",
    "settings: {}": "'settings' is empty",
    "trials: 0": "'trials' is 0, but must be an integer, at least 1",
    "trails: 3": "did you mean 'trials'?",
    "samples: 3": "unknown entry 'samples'",
    "objectives: [speed]": "'objectives' is ['speed'], but must be one of cost, worst_case",
    "objectives: [cost, effort, cross_track, worst_case]": "at most 3",
    "at_once: many": "'at_once' is 'many'",
}


@pytest.mark.parametrize("text", BAD)
def test_what_cannot_be_is_refused_in_one_sentence(tmp_path, text):
    with pytest.raises(AdpError) as refusal:
        tuning_of(tmp_path, text)
    assert BAD[text] in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.smoke
def test_the_command_tunes_and_goes_on(tmp_path, scheduler):
    file, out = tmp_path / "tune.yaml", tmp_path / "out"
    file.write_text(QUICK + "settings: {target_gain: {low: 0.05, high: 1.0, log: true}}\ntrials: 3")
    done = subprocess.run(
        [
            *(sys.executable, "-m", "adp_path_follower.cli.main", "tune", str(file)),
            *("--out", str(out), "--workers", "1"),
        ],
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert done.returncode == 0, done.stderr
    assert "3 settings tried for cost, on 1 runs each" in done.stdout
    again = adp("tune", str(file), "--out", str(out), "--scheduler", scheduler, "--trials", "4")
    assert again.returncode == 0, again.stderr
    assert "3 of 4 trials are there already" in again.stderr
    found = json.loads((out / "findings.json").read_text())
    assert found["trials"] == 4
    loaded = load_settings(Settings, "path_follower", out / "best.yaml")
    assert loaded.target.target_gain == found["best"]["settings"]["target_gain"]
    file.write_text(QUICK + "settings: {target_gain: {low: 0.05, high: 2.0, log: true}}\ntrials: 3")
    other = adp("tune", str(file), "--out", str(out))
    assert (other.returncode, other.stdout) == (2, "")
    assert "is of another tune, which differs in varied" in other.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--storage", "sqlite:////nowhere/study.db"], "'sqlite:////nowhere/study.db' cannot be"),
        (["--storage", "over there"], "storage 'over there' cannot be used"),
    ],
)
def test_a_database_that_cannot_be_used_is_named(tmp_path, arguments, words):
    file = tmp_path / "tune.yaml"
    file.write_text(QUICK + "settings: {target_gain: own}")
    done = adp("tune", str(file), "--out", str(tmp_path / "out"), *arguments)
    assert done.returncode == 2
    assert words in done.stderr
    assert done.stderr.count("\n") == 1


def test_options_and_a_file_do_not_mix(tmp_path):
    file = tmp_path / "tune.yaml"
    file.write_text(QUICK)
    done = adp("tune", str(file), "--params", str(PAPER), "--out", str(tmp_path / "out"))
    assert done.returncode == 2
    assert "are for a search without TUNE.yaml" in done.stderr
