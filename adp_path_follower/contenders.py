"""Who is compared: this package's controllers and their peers, each with how it is run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from adp_path_follower.baselines.registry import PEERS
from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.core.settings.schema import build, flatten, setting_fields
from adp_path_follower.shared_files import config_file
from adp_path_follower.simulation import ControllerFactory

OWN = {
    "adp": "Approximate optimal control, learned before the start (warm)",
    "adp_cold": "The same, learning from the first step on",
    "paper": "The paper's laws and gains, learning from the first step on",
}
CONTROLLERS: dict[str, str] = {**OWN, **{name: peer.description for name, peer in PEERS.items()}}

_RATE = 100.0  # [Hz]


@dataclass(frozen=True)
class Contender:
    """One controller and how it is run.

    Attributes:
        name: As in `CONTROLLERS`.
        settings: What it is made with.
        factory: Makes it.
        learning: How it starts: "cold" or "warm".
        rate: Control steps per second [Hz].

    """

    name: str
    settings: Settings
    factory: ControllerFactory
    learning: str
    rate: float


def contenders(settings: Settings, names: Sequence[str]) -> list[Contender]:
    """Return the controllers of these names.

    Raises:
        AdpError: There is no such controller.

    """
    found = []
    for name in names:
        if name in ("adp", "adp_cold"):
            mode = "warm" if name == "adp" else "cold"
            found.append(Contender(name, settings, PathFollower, mode, _RATE))
        elif name == "paper":
            found.append(Contender(name, _paper_laws(settings), PathFollower, "cold", _RATE))
        elif name in PEERS:
            peer = PEERS[name]
            rate = peer.control_rate or _RATE
            found.append(Contender(name, settings, peer.factory, "frozen", rate))
        else:
            raise AdpError(f"unknown controller '{name}': choose from {', '.join(CONTROLLERS)}")
    return found


def _paper_laws(settings: Settings) -> Settings:
    """Return the paper's learner for the target, cost and limits of other settings."""
    printed = flatten(load_settings(Settings, "path_follower", config_file("paper.yaml")))
    task = flatten(settings)
    groups = {field.name: field.group for field in setting_fields(Settings)}
    kept = {
        name: value
        for name, value in task.items()
        if groups[name] in ("target", "cost", "limits", "motion")
    }
    return build(Settings, {**printed, **kept})
