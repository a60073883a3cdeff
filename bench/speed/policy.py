"""Measure policy and learning step against bare matrix products, and against NMPC, in one run.

    python bench/speed/policy.py [--figure FILE.png] [--json FILE]

A learning step is that of `scheduling: arc_length`: Bellman errors of N samples and their normal
equations for L weights, and the solution. Its floor are numpy's products and LAPACK's solution for
the same shapes with nothing between them. The weights are those of the first L terms of a
polynomial basis, by rising degree.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path as FilePath

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from scipy.linalg.lapack import dpotrf, dpotrs
from tick import Drive
from timing import Row, arguments, in_turns, ratio, report

from adp_path_follower.core.basis import Basis, PolynomialBasis
from adp_path_follower.core.control.virtual_target import VirtualTarget
from adp_path_follower.core.driving.output import ControlOutput
from adp_path_follower.core.geometry import FloatArray, advance_pose, pose_in_frame
from adp_path_follower.core.learning.knot_model import KnotModel, fit
from adp_path_follower.core.path.library import lissajous
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.learning import LearningSettings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.drawing.figure_style import COLORS, STYLE
from adp_path_follower.study.comparison.nmpc import Nmpc

_WEIGHTS, _SAMPLES = (9, 24, 48, 104), (81, 400, 1000, 3000)
_FLOOR, _PEER = "bare products", "NMPC"
_NMPC_PERIOD = 0.05  # [s]


class FirstTerms(PolynomialBasis):
    """The first terms of a polynomial basis."""

    def __init__(self, size: int) -> None:
        """Take as many terms of the least degree that has so many."""
        degree = next(d for d in range(2, 9) if len(PolynomialBasis(d).labels) >= size)
        super().__init__(degree)
        self.labels = self.labels[:size]
        self._factors = self._factors[..., :size]


@dataclasses.dataclass(frozen=True)
class LearningWithBasis(LearningSettings):
    """Settings with a basis that has no name."""

    def __post_init__(self) -> None:
        """Check nothing: the numbers are those of valid settings."""

    @property
    def value_basis(self) -> Basis:
        """Return a basis of as many terms as there are listed weights."""
        return FirstTerms(len(self.initial_critic_weights))


def knot_model(weights: int, samples: int) -> KnotModel:
    """Return a model of so many samples for so many weights."""
    settings = load_settings(Settings, "path_follower")
    values = {
        field.name: getattr(settings.learning, field.name)
        for field in dataclasses.fields(settings.learning)
    }
    values |= {"sample_count": samples, "initial_critic_weights": (0.0,) * weights}
    learning = LearningWithBasis(**values)
    return KnotModel(dataclasses.replace(settings, learning=learning), 0.2)


def learning_step(weights: int, samples: int) -> Callable[[], object]:
    """Return the Bellman errors of N samples and the solution for L weights."""
    model = knot_model(weights, samples)
    ahead = np.random.default_rng(0).normal(size=weights)
    return lambda: fit(model.equations(slice(0, samples), ahead, 0.1, 0.5))


def bare_products(weights: int, samples: int) -> Callable[[], object]:
    """Return the products and the solution of such a step, without anything between them.

    σ'g Wc for both inputs and σ Wc; σ'(f + g u) as a combination of four terms of each sample;
    Xᵀ X and Xᵀ r; the solution by Cholesky's method.
    """
    random = np.random.default_rng(0)
    linear, angular, passing = random.normal(size=(3, samples, weights))
    terms, shares = random.normal(size=(samples, 4, weights)), random.normal(size=(samples, 1, 4))
    ahead, constant = random.normal(size=weights), random.normal(size=samples)
    regressor = np.empty((samples, 1, weights))
    ridge = np.eye(weights)

    def call() -> object:
        _ = linear @ ahead, angular @ ahead, passing @ ahead
        np.matmul(shares, terms, out=regressor)
        x = regressor[:, 0]
        vector = constant @ x
        matrix = x.T @ x
        matrix += ridge
        factor, _ = dpotrf(matrix, lower=1)
        return dpotrs(factor, vector, lower=1)

    return call


def steps_by_size(figure: FilePath | None) -> list[Row]:
    """Return learning steps of every size against their floors, and draw them."""
    rows, found = [], {}
    for weights in _WEIGHTS:
        for samples in _SAMPLES:
            cases = {
                "step": learning_step(weights, samples),
                _FLOOR: bare_products(weights, samples),
            }
            times = in_turns(cases, 30, max(2, 20_000 // (weights * samples)))
            found[weights, samples] = {name: float(np.median(row)) for name, row in times.items()}
            rows.append(
                Row(
                    f"learning step, {weights} weights, {samples} samples",
                    found[weights, samples]["step"],
                    ratio=ratio(times["step"], times[_FLOOR]),
                    against=_FLOOR,
                    target=1.5,
                )
            )
    if figure is not None:
        draw(found, figure)
    return rows


def draw(found: dict[tuple[int, int], dict[str, float]], file: FilePath) -> None:
    """Draw how the time grows with samples and weights."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(5.0, 3.8), layout="constrained")
        axes = figure.subplots()
        for color, weights in zip(COLORS, _WEIGHTS, strict=False):
            for name, style in (("step", "-o"), (_FLOOR, ":")):
                times = [found[weights, samples][name] for samples in _SAMPLES]
                label = f"{weights} weights" if name == "step" else None
                axes.loglog(_SAMPLES, times, style, color=color, label=label)
        axes.set(xlabel="samples", ylabel="time of a learning step [µs]")
        axes.set_xticks(_SAMPLES, [str(samples) for samples in _SAMPLES])
        axes.set_title("Dotted: the bare products of the same shapes")
        axes.legend()
        file.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(file)


class NmpcDrive:
    """A robot driven by NMPC at 20 Hz."""

    def __init__(self, settings: Settings) -> None:
        """Start beside the figure eight, and compile the solver."""
        self.controller = Nmpc(settings, lissajous(), np.zeros(1))
        self._pose: FloatArray = np.array([[0.3, 0.5, 0.4]])

    def tick(self) -> ControlOutput:
        """Return the next command."""
        output = self.controller.step(self._pose, _NMPC_PERIOD)
        command = output.command
        self._pose = advance_pose(self._pose, command[:, 0], command[:, 1], _NMPC_PERIOD)
        return output


def policy_of(drive: Drive) -> Callable[[], object]:
    """Return the evaluation of the policy: from the error at the target to the input."""
    for _ in range(300):
        drive.tick()
    follower = drive.follower
    target = VirtualTarget(
        follower.path, drive.settings.target, follower.arc_length, follower.reference
    )
    error = np.array([0.05, -0.03, 0.1])
    target.move(pose_in_frame(error, follower.path.frame(follower.arc_length).pose), 0.0)

    def call() -> object:
        return follower.law.actor_input(follower.law.situation(target, target.v_des))

    return call


def policy_products(weights: int) -> Callable[[], object]:
    """Return the products of a policy evaluation: σ and three derivatives times Wc, Wa, Wc'."""
    random = np.random.default_rng(0)
    rows, columns = random.normal(size=(4, weights)), random.normal(size=(weights, 3))
    return lambda: rows @ columns


def against_nmpc() -> list[Row]:
    """Return policy, learning step and ticks against the fastest NMPC."""
    settings = load_settings(Settings, "path_follower")
    nmpc, learning, frozen = NmpcDrive(settings), Drive(), Drive(None, "learning=false")
    for _ in range(100):  # until it follows
        nmpc.tick()
    size, samples = len(settings.learning.value_basis.labels), settings.learning.samples_per_step
    cases: dict[str, Callable[[], object]] = {
        "policy": policy_of(Drive(None, "learning=false")),
        "policy's products": policy_products(size),
        "step": learning_step(size, samples),
        "frozen": frozen.tick,
        "tick": learning.tick,
        "nmpc": nmpc.tick,
    }
    times = in_turns(cases, 60, 20)
    times["policy and step"] = times["policy"] + times["step"]
    peer = times["nmpc"]

    def row(what: str, key: str, target: float | None = None) -> Row:
        return Row(what, float(np.median(times[key])), "µs", ratio(times[key], peer), _PEER, target)

    return [
        row(f"NMPC, {nmpc.controller.solver}: control tick", "nmpc"),
        row("default: policy evaluation", "policy", 1.0 / 20.0),
        Row(
            "default: policy evaluation, and its products",
            float(np.median(times["policy"])),
            ratio=ratio(times["policy"], times["policy's products"]),
            against=_FLOOR,
            target=1.5,
        ),
        row("default: control tick, not learning, beside NMPC", "frozen"),
        row(f"default: learning step, {size} weights, {samples} samples, with solution", "step"),
        row("default: policy evaluation and learning step", "policy and step", 1.0 / 3.0),
        row("default: control tick, learning, beside NMPC", "tick", 1.0 / 3.0),
    ]


def main() -> None:
    """Print the table, draw the figure, and write the results if asked."""
    parser = arguments(__doc__)
    parser.add_argument("--figure", type=FilePath, help="draw the growth with samples and weights")
    given = parser.parse_args()
    report([*against_nmpc(), *steps_by_size(given.figure)], given.json)


if __name__ == "__main__":
    main()
