"""The parameter file that `adp tune` writes starts the controller with the settings it found."""

from __future__ import annotations

import pytest
from std_msgs.msg import String

from folders import CONFIG
from live_nodes import FRAMES

pytest.importorskip("optuna", reason="the extra 'sweep' is not installed")

import optuna

from adp_path_follower.messages.configuration import parse_configuration
from adp_path_follower.ros.runtime.qos import ALL_CHANGES
from adp_path_follower.study.sweeps.request import read_tuning
from adp_path_follower.study.sweeps.results import results, write_results
from adp_path_follower.study.sweeps.study import open_study, tune

pytestmark = pytest.mark.nodes

PAPER = CONFIG / "paper.yaml"
TUNE = f"""
params: {PAPER}
starts: [[0.1, 0.1, 0.1]]
learning: frozen
duration: 0.5
settings:
  actor_gain: {{low: 6.0, high: 7.0}}
  sample_half_widths: {{low: 0.2, high: 0.4}}
  samples_per_axis: {{low: 2, high: 4}}
  critic: [least_squares]
trials: 2
"""


class _Inline:
    """Workers that do everything at once, here."""

    def begin(self, function, *arguments):
        """Return what the function makes of the arguments."""
        return function(*arguments)

    def result(self, future):
        """Return it."""
        return future


def test_the_controller_starts_with_what_was_found(peer, start, tmp_path):
    file = tmp_path / "tune.yaml"
    file.write_text(TUNE)
    tuning = read_tuning(file)
    study = open_study(tuning, f"sqlite:///{tmp_path / 'study.db'}", shared=False)
    tune(study, tuning, _Inline(), lambda fraction: None)
    assert all(trial.state == optuna.trial.TrialState.COMPLETE for trial in study.get_trials())
    found = results(study, tuning)
    write_results(found, "a test", tmp_path)

    told = peer.listen(String, "path_follower/configuration", ALL_CHANGES)
    controller = start("controller", "--params-file", str(tmp_path / "best.yaml"))
    peer.until_matched(peer.path)
    peer.send_path(frame=FRAMES[0])
    peer.until(lambda: told, f"the configuration of {controller.output()}")
    settings = parse_configuration(told[-1].data).settings
    assert found.best is not None
    assert settings == found.settings(found.best)
    assert 6.0 <= settings.learning.actor_gain <= 7.0
    assert controller.stop() == 0
