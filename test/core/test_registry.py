"""Bases, far policies and peers of a user's own, and the plugins that register them."""

import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import adp_path_follower as adp
from adp_path_follower.core import registry
from adp_path_follower.core.basis import OWN_BASES, PolynomialBasis, make_basis
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.learning import OWN_FAR_POLICIES
from adp_path_follower.core.settings.schema import build
from adp_path_follower.study.comparison.controllers import OWN_PEERS, contender, known_controllers
from adp_path_follower.study.comparison.error_laws import Lqr
from folders import ROOT


class Quadratic:
    """The polynomial basis of degree 2, as a user would write it."""

    labels = ("s²", "s y", "s θ", "y²", "y θ", "θ²")

    def value(self, error):
        """Return the terms."""
        s, y, theta = np.moveaxis(error, -1, 0)
        return np.stack([s * s, s * y, s * theta, y * y, y * theta, theta * theta], axis=-1)

    def gradient(self, error):
        """Return their slopes."""
        s, y, theta = np.moveaxis(error, -1, 0)
        no = np.zeros_like(s)
        rows = [(2 * s, no, no), (y, s, no), (theta, no, s)]
        rows += [(no, 2 * y, no), (no, theta, y), (no, no, 2 * theta)]
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


class Still:
    """A far policy that waits."""

    def __init__(self, settings):
        pass

    def modified_input(self, zeta, curvature, feedforward):
        """Return what makes the command zero."""
        return -feedforward


@pytest.fixture(autouse=True)
def forgotten():
    """Forget after each test what it has registered."""
    yield
    for known in (OWN_BASES, OWN_FAR_POLICIES, OWN_PEERS):
        known._parts.clear()
    make_basis.cache_clear()


@given(seed=st.integers(0, 1000))
def test_an_own_basis_is_to_the_learner_what_the_same_terms_of_the_package_are(seed):
    adp.register_basis("own", Quadratic)
    random = np.random.default_rng(seed)
    zeta, matrix = random.normal(size=(3, 4)), random.normal(size=(3, 3))
    matrix = matrix + matrix.T
    for frame in ("serret_frenet", "half_angle"):
        own, ours = make_basis("own", 6, frame), make_basis("polynomial", 2, frame)
        assert own.labels == ours.labels
        np.testing.assert_allclose(own.value(zeta), ours.value(zeta), atol=1e-14)
        np.testing.assert_allclose(own.gradient(zeta), ours.gradient(zeta), atol=1e-14)
        np.testing.assert_allclose(
            own.quadratic_weights(matrix), ours.quadratic_weights(matrix), atol=1e-9
        )


def test_an_own_basis_drives_as_the_same_terms_of_the_package_do():
    adp.register_basis("own", Quadratic)
    own = adp.simulate("circle:0.5", adp.load_settings(basis="own"), duration=3.0)
    ours = adp.simulate("circle:0.5", adp.load_settings(basis_degree=2), duration=3.0)
    np.testing.assert_allclose(own.cost, ours.cost, rtol=1e-8)
    assert isinstance(make_basis("polynomial", 2, "serret_frenet"), PolynomialBasis)


def without(name):
    members = {key: value for key, value in vars(Quadratic).items() if key != name}
    return type("Broken", (), members)


def having(**members):
    return type("Broken", (Quadratic,), members)


@pytest.mark.parametrize(
    ("basis", "text"),
    [
        (without("gradient"), "has no 'gradient': it needs labels, value(error) and gradient"),
        (without("labels"), "has no 'labels'"),
        (having(labels=("a",) * 6), "must differ"),
        (having(labels=("a", "b")), "shape (6,), but must be finite and of shape (2,)"),
        (having(gradient=lambda self, e: np.zeros((*e.shape, 6))), "but must be finite and of"),
        (having(gradient=lambda self, e: 2.0 * Quadratic().gradient(e)), "not that of its value"),
        (
            having(
                value=lambda self, e: Quadratic().value(e) * np.array([1, 1, 1, 0, 1, 1]),
                gradient=lambda self, e: (
                    Quadratic().gradient(e) * np.array([1, 1, 1, 0, 1, 1])[:, None]
                ),
            ),
            "no sum of its terms is y² near the path",
        ),
        (
            having(
                value=lambda self, e: Quadratic().value(e) + e[..., :1],
                gradient=lambda self, e: Quadratic().gradient(e) + np.array([1.0, 0.0, 0.0]),
            ),
            "has a slope where the error is zero",
        ),
    ],
)
def test_a_wrong_basis_is_rejected_with_what_is_wrong(basis, text):
    with pytest.raises(AdpError) as caught:
        adp.register_basis("wrong", basis)
    assert text in str(caught.value)
    assert "basis 'wrong'" in str(caught.value)
    with pytest.raises(AdpError, match="one of"):
        build(Settings, {"basis": "wrong"})


@pytest.mark.parametrize("name", ["polynomial", "two words", "", "a-b", None])
def test_a_name_that_is_taken_or_none_is_rejected(name):
    with pytest.raises(AdpError):
        adp.register_basis(name, Quadratic)


def test_an_own_far_policy_drives_far_from_the_path():
    adp.register_far_policy("still", Still)
    settings = adp.load_settings(wide_region="still")
    run = adp.simulate("line", settings, starts=[0.0, 5.0, 0.0], duration=1.0)
    assert run.max_inputs.max() == 0.0


@pytest.mark.parametrize(
    ("policy", "text"),
    [
        (lambda settings: object(), "has no 'modified_input"),
        (
            lambda settings: type("", (), {"modified_input": lambda self, z, c, f: z})(),
            "returns shape (4,)",
        ),
    ],
)
def test_a_wrong_far_policy_is_rejected_with_what_is_wrong(policy, text):
    with pytest.raises(AdpError) as caught:
        adp.register_far_policy("wrong", policy)
    assert text in str(caught.value)


def test_an_own_peer_is_named_and_compared():
    adp.register_peer("mine", Lqr, "A law of mine", control_rate=50.0)
    assert known_controllers()["mine"] == "A law of mine"
    found = contender("mine", build(Settings, {}))
    assert (found.name, found.rate, found.factory) == ("mine", 50.0, Lqr)


class FlatOutput(Lqr):
    """A peer whose commands have lost their axis of robots."""

    def command(self, pose, dt, frame, error):
        """Return the first robot's command alone."""
        return super().command(pose, dt, frame, error)[0]


@pytest.mark.parametrize(
    ("peer", "text"),
    [
        (lambda settings, path, places: object(), "has no 'settings'"),
        (FlatOutput, "command of the output of step for 2 robots has shape (2,)"),
    ],
)
def test_a_wrong_peer_is_rejected_with_what_is_wrong(peer, text):
    with pytest.raises(AdpError) as caught:
        adp.register_peer("wrong", peer)
    assert text in str(caught.value)


def adp_command(*arguments, folder, **environment):
    """Run the real command in a folder."""
    return subprocess.run(
        [sys.executable, "-m", "adp_path_follower.cli.main", *arguments],
        capture_output=True,
        text=True,
        timeout=200,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
    )


@pytest.mark.parametrize("way", ["option", "file", "module"])
def test_a_plugin_serves_the_command(tmp_path, way):
    text = (ROOT / "examples" / "own_basis.py").read_text()
    (tmp_path / "mine.py").write_text(text)
    run = ("simulate", "--set", "basis=bounded", "--duration", "0.1")
    if way == "option":
        done = adp_command("--plugin", "mine.py", *run, folder=tmp_path)
    elif way == "file":
        done = adp_command(*run, folder=tmp_path, ADP_PLUGINS="mine.py")
    else:
        paths = os.pathsep.join([str(tmp_path), str(ROOT)])
        done = adp_command(*run, folder=tmp_path, ADP_PLUGINS="mine", PYTHONPATH=paths)
    assert done.returncode == 0, done.stderr


def test_a_plugin_of_peers_is_listed_and_chosen_in_yaml(tmp_path):
    (tmp_path / "mine.yaml").write_text("/**:\n  ros__parameters:\n    wide_region: turn_first\n")
    plugin = str(ROOT / "examples" / "own_controller.py")
    done = adp_command("compare", "--list", folder=tmp_path, ADP_PLUGINS=plugin)
    assert done.stdout.splitlines()[-1].split(maxsplit=1)[0] == "proportional"
    done = adp_command("parameters", "--params", "mine.yaml", folder=tmp_path, ADP_PLUGINS=plugin)
    assert 'wide_region: "turn_first"' in done.stdout, done.stderr


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (None, "there is no such file"),
        ("1 / 0", "ZeroDivisionError"),
        ("import adp_path_follower as adp\nadp.register_basis('b', object)", "has no 'labels'"),
    ],
)
def test_a_plugin_that_fails_is_named_in_one_sentence(tmp_path, text, problem):
    if text is not None:
        (tmp_path / "mine.py").write_text(text)
    done = adp_command("parameters", "--set", "basis=b", folder=tmp_path, ADP_PLUGINS="mine.py")
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("adp: plugin 'mine.py' of ADP_PLUGINS: ")
    assert problem in line


def test_names_of_the_package_never_import_plugins(monkeypatch):
    monkeypatch.setenv(registry.PLUGINS, "not_there.py")
    build(Settings, {"basis": "paper", "scheduling": "path_state", "wide_region": "riccati"})
