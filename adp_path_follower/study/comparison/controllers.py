"""The controllers that are compared: this package's own and its peers, by name.

A tuning of a peer has the least score of a small grid: the median J/J* of forty starts over 30 s,
plus the RMS cross-track error in centimetres from 10 s to 60 s, which is through the first sharp
bend; on the paper's figure eight from its beginning, |s|, |y| <= 1 m and |theta| <= 1 rad at the
start, v_des = 0.5 m/s, no limits.
"""

import math
from dataclasses import dataclass, fields, replace

import numpy as np

from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.driving.output import ControlOutput
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.registry import Registry, load_plugins
from adp_path_follower.core.robot.model import IDEAL, RobotModel
from adp_path_follower.core.robot.robot import settings_of
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.core.settings.robot import ROBOT_MODELS
from adp_path_follower.core.settings.schema import build, update
from adp_path_follower.resources import config_file
from adp_path_follower.study.comparison import error_laws, nmpc, steering
from adp_path_follower.study.simulation.simulate import ControllerFactory


@dataclass(frozen=True)
class Peer:
    """A controller to compare with."""

    description: str  # description, and where it is published
    factory: ControllerFactory  # makes it
    control_rate: float | None = None  # steps per second [Hz]; None for the simulation's


PEERS = {  # by their names in tables and on the command line
    "pure_pursuit": Peer("Pure pursuit (Coulter 1992), look-ahead 1 m", steering.PurePursuit),
    "pure_pursuit_tuned": Peer(
        "Pure pursuit (Coulter 1992), look-ahead tuned: 0.6 m", steering.TunedPurePursuit
    ),
    "regulated_pure_pursuit": Peer(
        "Regulated pure pursuit (Macenski et al. 2023) with Nav2's defaults, without a costmap",
        steering.RegulatedPurePursuit,
    ),
    "regulated_pure_pursuit_tuned": Peer(
        "Regulated pure pursuit (Macenski et al. 2023), look-ahead by speed and slowing down tuned",
        steering.TunedRegulatedPurePursuit,
    ),
    "stanley": Peer("Stanley's law (Hoffmann et al. 2007) on a virtual bicycle", steering.Stanley),
    "stanley_tuned": Peer(
        "Stanley's law (Hoffmann et al. 2007) at the robot, with curvature feed-forward, tuned",
        steering.TunedStanley,
    ),
    "lapierre_soetanto": Peer(
        "Nonlinear law with a virtual target (Lapierre, Soetanto, Pascoal 2003) at v = v_des",
        error_laws.LapierreSoetanto,
    ),
    "lapierre_soetanto_tuned": Peer(
        "Nonlinear law with a virtual target (Lapierre, Soetanto, Pascoal 2003) at "
        "v = v_des - k s, tuned",
        error_laws.TunedLapierreSoetanto,
    ),
    "lqr": Peer(
        "Linear-quadratic regulator scheduled by curvature, with the true input matrix",
        error_laws.Lqr,
    ),
    "nmpc": Peer(
        "Nonlinear model predictive control over 3 s (CasADi), with the curvature ahead",
        nmpc.Nmpc,  # the only one that needs CasADi
        control_rate=20.0,
    ),
}

OWN = {
    "adp": "Approximate optimal control, learned before the start (warm)",
    "adp_cold": "The same, learning from the first step on",
    "paper": "The paper's laws and gains, learning from the first step on",
}

CONTROLLERS: dict[str, str] = {**OWN, **{name: peer.description for name, peer in PEERS.items()}}

OWN_PEERS: Registry[Peer] = Registry("peer", tuple(CONTROLLERS))  # of `register_peer`

RATE = 100.0  # [Hz]


def register_peer(
    name: str, factory: ControllerFactory, description: str = "", control_rate: float | None = None
) -> None:
    """Register a controller, so that `adp compare --controllers NAME` runs it with the others.

    Example: `adp.register_peer("slow", Slow)`, where `Slow(settings, path, arc_length)` is an
    `adp.PeerController`, or any class with `settings`, `path` and `step(pose, dt)`;
    examples/own_controller.py has all of it.

    Args:
        name: Letters, digits and _.
        factory: Makes it from settings, path and the virtual targets' arc lengths (B,) [m].
        description: Description for `adp compare --list`.
        control_rate: Steps per second [Hz]; None for the simulation's.

    Raises:
        AdpError: Something of `Controller` is missing, or its output has another shape; or the
            name is taken by the package.

    """
    path = Path.from_points([[0.0, 0.0], [10.0, 0.0]], closed=False)
    controller = factory(build(Settings, {}), path, np.zeros(2))
    for member in ("settings", "path", "step"):
        if not hasattr(controller, member):
            raise AdpError(
                f"peer '{name}' has no '{member}': it needs settings, path and step(pose, dt)"
            )
    poses, known = np.full((2, 3), 0.1), steering.PurePursuit(controller.settings, path, [0, 0])
    output, expected = controller.step(poses, 0.0), known.step(poses, 0.0)
    for item in fields(ControlOutput):
        shape = np.shape(getattr(expected, item.name))
        found = np.asarray(getattr(output, item.name, math.nan))
        if found.shape != shape or not np.isfinite(found.astype(float)).all():
            raise AdpError(
                f"peer '{name}': {item.name} of the output of step for 2 robots has shape "
                f"{found.shape}, but must be finite and of shape {shape}"
            )
    OWN_PEERS.register(name, Peer(description, factory, control_rate))


def known_controllers() -> dict[str, str]:
    """Return the name and the description of each controller, those of plugins too."""
    load_plugins()
    own = {name: peer.description for name, peer in OWN_PEERS.parts().items()}
    return {**CONTROLLERS, **own}


@dataclass(frozen=True)
class Contender:
    """One controller and how it is run."""

    name: str  # as in `CONTROLLERS`
    settings: Settings  # settings of the controller
    factory: ControllerFactory  # makes it
    learning: str  # how it starts: "cold" or "warm"
    rate: float  # control steps per second [Hz]


def contender(name: str, settings: Settings, model: RobotModel = IDEAL) -> Contender:
    """Return the controller of a name; raise AdpError for an unknown one.

    NAME+ideal, NAME+learned and NAME+given drive on our estimator with that `robot_model`, of which
    `model` is the given one. By the plain name only adp and adp_cold take the settings' own.
    """
    controller, plus, kind = name.partition("+")
    if plus and kind not in ROBOT_MODELS:
        raise AdpError(
            f"controller '{name}' has the robot model '{kind}', but must have one of "
            f"{', '.join(ROBOT_MODELS)}"
        )
    if plus or not controller.startswith("adp"):
        given = settings_of(model) if kind == "given" else {}
        settings = update(settings, {**given, "robot_model": kind or "ideal"})
    if controller in ("adp", "adp_cold"):
        mode = "warm" if controller == "adp" else "cold"
        return Contender(name, settings, PathFollower, mode, RATE)
    if controller == "paper":
        return Contender(name, _paper_laws(settings), PathFollower, "cold", RATE)
    peer = PEERS.get(controller) or OWN_PEERS.find(controller)
    if peer is None:
        raise AdpError(
            f"unknown controller '{controller}': choose from {', '.join(known_controllers())}"
        )
    return Contender(name, settings, peer.factory, "frozen", peer.control_rate or RATE)


def _paper_laws(settings: Settings) -> Settings:
    """Return the paper's learner for the target, cost and limits of other settings."""
    return replace(
        load_settings(Settings, "path_follower", config_file("paper.yaml")),
        target=settings.target,
        cost=settings.cost,
        limits=settings.limits,
        motion=settings.motion,
        robot=settings.robot,
    )
