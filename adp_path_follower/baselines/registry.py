"""The peers by name: their usual numbers, and one tuning each.

A tuning has the least score of a small grid: the median J/J* of forty starts over 30 s, plus the
RMS cross-track error in centimetres from 10 s to 60 s, which is through the first sharp bend; on
the paper's figure eight from its beginning, |s|, |y| <= 1 m and |theta| <= 1 rad at the start,
v_des = 0.5 m/s, no limits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType

from adp_path_follower.baselines import lapierre_soetanto, pure_pursuit, stanley
from adp_path_follower.baselines.lapierre_soetanto import LapierreSoetanto
from adp_path_follower.baselines.lqr import Lqr
from adp_path_follower.baselines.pure_pursuit import PurePursuit, RegulatedPurePursuit
from adp_path_follower.baselines.stanley import Stanley
from adp_path_follower.core.control.interface import Controller
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.settings.groups import Settings

Factory = Callable[[Settings, Path, FloatArray], Controller]


@dataclass(frozen=True)
class Peer:
    """A controller to compare with.

    Attributes:
        name: Name in tables and on the command line.
        description: What it is, and where it is published.
        factory: Makes it from settings, path and the virtual targets' arc lengths (B,) [m].
        control_rate: Steps per second [Hz]; None for the simulation's.

    """

    name: str
    description: str
    factory: Factory
    control_rate: float | None = None


def _nmpc(settings: Settings, path: Path, arc_length: FloatArray) -> Controller:
    """Make the only peer that needs CasADi.

    Raises:
        AdpError: There is no CasADi.

    """
    from adp_path_follower.baselines.nmpc import Nmpc

    return Nmpc(settings, path, arc_length)


_PEERS = (
    Peer(
        "pure_pursuit",
        "Pure pursuit (Coulter 1992), look-ahead 1 m",
        PurePursuit,
    ),
    Peer(
        "pure_pursuit_tuned",
        f"Pure pursuit (Coulter 1992), look-ahead tuned: {pure_pursuit.TUNED_LOOKAHEAD:g} m",
        partial(PurePursuit, lookahead=pure_pursuit.TUNED_LOOKAHEAD),
    ),
    Peer(
        "regulated_pure_pursuit",
        "Regulated pure pursuit (Macenski et al. 2023) with Nav2's defaults, without a costmap",
        RegulatedPurePursuit,
    ),
    Peer(
        "regulated_pure_pursuit_tuned",
        "Regulated pure pursuit (Macenski et al. 2023), look-ahead by speed and slowing down tuned",
        partial(RegulatedPurePursuit, rules=pure_pursuit.TUNED_RULES),
    ),
    Peer(
        "stanley",
        "Stanley's law (Hoffmann et al. 2007) on a virtual bicycle",
        Stanley,
    ),
    Peer(
        "stanley_tuned",
        "Stanley's law (Hoffmann et al. 2007) at the robot, with curvature feed-forward, tuned",
        partial(Stanley, gains=stanley.TUNED_GAINS),
    ),
    Peer(
        "lapierre_soetanto",
        "Nonlinear law with a virtual target (Lapierre, Soetanto, Pascoal 2003) at v = v_des",
        LapierreSoetanto,
    ),
    Peer(
        "lapierre_soetanto_tuned",
        "Nonlinear law with a virtual target (Lapierre, Soetanto, Pascoal 2003) at "
        "v = v_des - k s, tuned",
        partial(LapierreSoetanto, gains=lapierre_soetanto.TUNED_GAINS),
    ),
    Peer(
        "lqr",
        "Linear-quadratic regulator scheduled by curvature, with the true input matrix",
        Lqr,
    ),
    Peer(
        "nmpc",
        "Nonlinear model predictive control over 3 s (CasADi), with the curvature ahead",
        _nmpc,
        control_rate=20.0,
    ),
)

PEERS: Mapping[str, Peer] = MappingProxyType({peer.name: peer for peer in _PEERS})
