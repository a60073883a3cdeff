"""The settings of the learner and of the policy far from the path."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from adp_path_follower.core.basis import BASES, FRAMES, OWN_BASES, Basis, make_basis
from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.registry import Registry
from adp_path_follower.core.settings.schema import POSITIVE, setting

_STRUCTURE = "the weights, and the topics that publish them, are those of its terms"
_SCHEDULE = "no weights can go from one learner to the other"
# Weights of s², s y, s θ, y², y θ, θ²: the Riccati solution for the default speed, gains and cost
# on a straight line.
_QUADRATIC_WEIGHTS = (0.905, 0.0, 0.0, 2.8284, 2.0, 1.4142)
_MOST_PREVIEW = 1000  # knots

SCHEDULINGS = ("path_state", "arc_length")
WIDE_REGIONS = ("none", "riccati", "approach", "value_grid")
# Registered by `register_far_policy`; makes a policy of the settings.
OWN_FAR_POLICIES: Registry[Callable[[Any], Any]] = Registry("far policy", WIDE_REGIONS)


@dataclass(frozen=True)
class LearningSettings:
    """Learning."""

    learning: bool = setting(True, "Learn while driving; false keeps the weights as they are.")
    basis: str = setting(
        "polynomial",
        "Basis of the value function: all monomials of the error up to basis_degree, the paper's "
        "terms, or those as they are printed, which leave the path (adp docs method).",
        symbol="σ",
        choices=BASES,
        registry=OWN_BASES,
        read_only=_STRUCTURE,
    )
    basis_degree: int = setting(
        6, "Highest degree of basis: polynomial.", low=2, high=8, read_only=_STRUCTURE
    )
    frame: str = setting(
        "half_angle",
        "Coordinates of the position error in the basis: along the path's tangent and normal "
        "(the paper's), or turned from there by half the heading error.",
        choices=FRAMES,
        read_only=_STRUCTURE,
    )
    scheduling: str = setting(
        "arc_length",
        "How the value function knows the path: by weights that change along it, learned for what "
        "lies ahead of the robot, or by φ among the variables of the basis (the paper's).",
        choices=SCHEDULINGS,
        read_only=_SCHEDULE,
    )
    critic: str = setting(
        "least_squares",
        "How the critic learns: by solving for the weights with the least Bellman errors, or by "
        "the paper's normalised gradient.",
        choices=("least_squares", "gradient"),
    )
    critic_gain_measured: float = setting(
        0.0,
        "Gain of the Bellman error at the measured state, for critic: gradient with scheduling: "
        "path_state.",
        symbol="η_c1",
        low=0.0,
        high=1e4,
    )
    critic_gain_sampled: float = setting(
        10.0,
        "Gain of the Bellman errors extrapolated to the sampled states, for critic: gradient.",
        symbol="η_c2",
        low=0.0,
        high=1e4,
    )
    actor_gain: float = setting(
        50.0,
        "Rate at which the actor follows the critic.",
        symbol="η_a",
        unit="1/s",
        low=0.0,
        high=1e4,
    )
    actor_weight_bound: float = setting(
        1000.0,
        "Norm that the smooth projection keeps the actor weights below.",
        symbol="W̄",
        low=POSITIVE,
        high=1e6,
    )
    sample_half_widths: tuple[float, float, float, float] = setting(
        (1.3, 1.3, 1.3, 0.5),
        "Half-width of the region of sampled states about the origin, along s [m], y [m], θ [rad] "
        "and φ (below 1, for φ = ±1 is s_p = ±∞; only for scheduling: path_state); with arc_length "
        "s and y are more above 2 m/s, in proportion.",
        symbol="ζ_j",
        low=POSITIVE,
        high=100.0,
    )
    samples_per_axis: tuple[int, int, int, int] = setting(
        (3, 3, 3, 3),
        "Number of sampled values along s, y, θ and φ, a grid, for scheduling: path_state.",
        symbol="N",
        low=1,
        high=50,
    )
    sample_count: int = setting(
        384,
        "Number of scattered sampled states for scheduling: arc_length. More make learning "
        "slower, never a control step.",
        symbol="N",
        low=16,
        high=65536,
    )
    samples_per_step: int = setting(
        160,
        "How many of them one control step works off. Until there are weights for the whole "
        "preview, so many must do for each knot.",
        low=1,
        high=65536,
    )
    sample_seed: int = setting(0, "Seed of the scattered samples.", low=0, high=999_999)
    knot_spacing: float = setting(
        0.2,
        "Distance along the path between two sets of weights, for scheduling: arc_length.",
        unit="m",
        low=0.01,
        high=10.0,
    )
    preview_distance: float = setting(
        2.4,
        "How far ahead of the robot weights are learned, for scheduling: arc_length; above 2 m/s, "
        "farther in proportion.",
        unit="m",
        low=0.02,
        high=100.0,
    )
    initial_weights: str = setting(
        "riccati",
        "Weights at the start and after ~/reset_learning: the Riccati solution's for these "
        "settings, or those that are listed below.",
        symbol="Ŵ(0)",
        choices=("riccati", "listed"),
    )
    initial_critic_weights: tuple[float, ...] = setting(
        _QUADRATIC_WEIGHTS,
        "Listed critic weights: one for each term of the basis, or for the six quadratic ones of "
        "basis: polynomial, which come first.",
        symbol="Ŵc(0)",
        low=-1e6,
        high=1e6,
    )
    initial_actor_weights: tuple[float, ...] = setting(
        _QUADRATIC_WEIGHTS, "Listed actor weights, likewise.", symbol="Ŵa(0)", low=-1e6, high=1e6
    )

    def __post_init__(self) -> None:
        """Reject parts, weights and grids that do not fit each other."""
        basis = self.value_basis
        if self.scheduling == "arc_length" and basis.depends_on_path_state:
            raise SettingsError(
                f"setting 'basis' is '{self.basis}', whose terms of φ need scheduling: path_state "
                "instead of arc_length; or choose basis: polynomial"
            )
        if self.initial_weights == "listed":
            for name in ("initial_critic_weights", "initial_actor_weights"):
                self._check_size(name, len(getattr(self, name)))
        if self.sample_half_widths[3] >= 1.0:
            raise SettingsError(
                f"setting 'sample_half_widths' is {list(self.sample_half_widths)}, but its fourth "
                "value (φ) must be below 1: φ = 1 is the end of an infinitely long path"
            )
        if math.prod(self.samples_per_axis) > 10_000:
            raise SettingsError(
                f"setting 'samples_per_axis' is {list(self.samples_per_axis)}, but its product, "
                "the number of samples, must be at most 10000"
            )
        if self.scheduling == "arc_length" and self.sample_count < 2 * len(basis.labels):
            raise SettingsError(
                f"setting 'sample_count' is {self.sample_count}, but must be at least "
                f"{2 * len(basis.labels)}, twice the number of terms of the basis: raise it, or "
                "lower 'basis_degree'"
            )
        if self.preview_distance < 2.0 * self.knot_spacing:
            raise SettingsError(
                f"setting 'preview_distance' is {self.preview_distance:g} m, but must be at least "
                f"twice 'knot_spacing' ({self.knot_spacing:g} m)"
            )
        if self.preview_distance > _MOST_PREVIEW * self.knot_spacing:
            raise SettingsError(
                f"setting 'preview_distance' is {self.preview_distance:g} m, but must be at most "
                f"{_MOST_PREVIEW} times 'knot_spacing' ({self.knot_spacing:g} m)"
            )

    def _check_size(self, name: str, given: int) -> None:
        labels = self.value_basis.labels
        quadratic_will_do = self.basis == "polynomial" and given == len(_QUADRATIC_WEIGHTS)
        if given != len(labels) and not quadratic_will_do:
            raise SettingsError(
                f"setting '{name}' has {given} values, but the basis '{self.basis}' needs "
                f"{len(labels)}: one for each of {', '.join(labels)}"
            )

    @property
    def value_basis(self) -> Basis:
        """Return the basis that is named."""
        return make_basis(self.basis, self.basis_degree, self.frame)


@dataclass(frozen=True)
class PolicySettings:
    """Fallback and far policies."""

    fallback: str = setting(
        "riccati",
        "Policy where the learned value function does not decrease as it must (the Bellman error "
        "exceeds half of the running cost): the Riccati policy in the half-angle frame, or none.",
        choices=("riccati", "none"),
    )
    wide_region: str = setting(
        "value_grid",
        "Policy far from the path, where nothing is learned: that of a value function on a grid, "
        "found once for these settings and kept in ~/.cache (approach drives until it is there); "
        "towards the path at approach_angle (it needs no reverse); the Riccati policy in the "
        "half-angle frame; or none (the learned policy everywhere).",
        choices=WIDE_REGIONS,
        registry=OWN_FAR_POLICIES,
    )
    wide_region_levels: tuple[float, float] = setting(
        (1.0, 1.25),
        "Errors, as multiples of sample_half_widths, at which the policy starts and ends to change "
        "from the learned one to that of wide_region; to value_grid at 0.7 of them, and below "
        "0.5 m/s nearer to the path in proportion.",
        low=POSITIVE,
        high=1e6,
    )
    approach_angle: float = setting(
        1.5,
        "Largest angle to the path at which wide_region: approach drives towards it.",
        unit="rad",
        low=0.1,
        high=1.5,
    )
    tight_within: float = setting(
        0.01,
        "Distance from the path [m], and angle to it [rad], within which a robot that is not ideal "
        "is held on the path more strictly than the cost asks for; 0: nowhere.",
        low=0.0,
        high=1e6,
    )

    def __post_init__(self) -> None:
        """Reject levels that do not rise."""
        start, end = self.wide_region_levels
        if not start < end:
            raise SettingsError(
                f"setting 'wide_region_levels' is [{start:g}, {end:g}], but must rise"
            )
