"""Follow paths with a unicycle robot by online approximate optimal control.

Everything that a script needs is here, and is imported when it is first used:

    import adp_path_follower as adp

    settings = adp.load_settings("default", desired_speed=0.3)
    path = adp.path([[0, 0], [3, 0], [5, 2]])
    print(adp.simulate(path, settings, duration=20))
    print(adp.compare("circle:0.5", settings, controllers=["adp", "lqr"]))
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from adp_path_follower.core.control.far_from_path import register_far_policy
    from adp_path_follower.core.driving.driver import Driver
    from adp_path_follower.core.driving.follower import PathFollower
    from adp_path_follower.core.own_basis import register_basis
    from adp_path_follower.front import analyze, compare, load_settings, optimum, path, simulate
    from adp_path_follower.study.comparison.controllers import register_peer
    from adp_path_follower.study.comparison.peer import PeerController

__version__ = "0.1.0"

__all__ = [
    "Driver",
    "PathFollower",
    "PeerController",
    "analyze",
    "compare",
    "load_settings",
    "optimum",
    "path",
    "register_basis",
    "register_far_policy",
    "register_peer",
    "simulate",
]

_HOMES = {  # of those that are not of `front`
    "Driver": "core.driving.driver",
    "PathFollower": "core.driving.follower",
    "PeerController": "study.comparison.peer",
    "register_basis": "core.own_basis",
    "register_far_policy": "core.control.far_from_path",
    "register_peer": "study.comparison.controllers",
}


def __getattr__(name: str) -> Any:
    """Return one of `__all__`, imported now: the nodes never wait for it."""
    if name not in __all__:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    module = importlib.import_module(f"{__name__}.{_HOMES.get(name, 'front')}")
    return getattr(module, name)


def __dir__() -> list[str]:
    """Return the public names, also those that are not imported yet."""
    return sorted({*globals(), *__all__})
