"""Compare the controller without a robot model, with a learned one, and tuned peers.

    python bench/robots/random_robots.py [--robots 200] [--first 0]
        [--plant analytic|mujoco] [--contenders ideal,learned,known,peers] [--cache FILE]

J is taken along the true motion; distances are those of the true pose after 8 s. "Best" means at
least as good as every variant of every peer on that robot, so each peer is tuned for each robot.

200 robots on MuJoCo (mujoco_results.json; with it as the cache, only what it lacks is driven):

| contender | best in J | in RMS | in both | worst J | worst RMS | median RMS [mm] | variation |
|---|---|---|---|---|---|---|---|
| ideal | 44 % | 2 % | 2 % | 2.28 | 18.1 | 31.8 | 1.17 |
| learned | 98 % | 96 % | 94 % | 1.52 | 1.19 | 2.8 | 0.81 |
| known | 100 % | 100 % | 99 % | 1.12 | 1.18 | 2.0 | 0.72 |
| best peer | | | | | | 7.1 | |

Worst are ratios to the best peer's. Learned robots lose in RMS where the pose has 1 to 2 cm of
noise, and in J where it is small, and the launch is most of it. On robots 200 to 239 the
learned one is best in both on 82 %, the known one on 95 %; only corners among them were looked at.
On 240 to 259 it is on 90 and 100 %. On eight that lose in RMS, the lateral estimate is wrong by
2.4 mm after 8 s, and by 1.8 mm with the robot known: 2.1 mm with only delay and lags known, which
are found 6 ms too long and 16 ms too short, 2.3 mm with only gains and bias known.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping
from pathlib import Path as FilePath

import numpy as np
from drives import Outcome, drive, ours, peer, start_pose
from paths import PATHS
from plants import AnalyticPlant, Plant
from robots import random_robot

from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.study.comparison.controllers import ControllerFactory
from adp_path_follower.study.comparison.error_laws import Lqr, TunedLapierreSoetanto
from adp_path_follower.study.comparison.steering import (
    PurePursuit,
    TunedRegulatedPurePursuit,
    TunedStanley,
)

PEERS: dict[str, ControllerFactory] = {
    **{
        f"pure pursuit {distance:g} m": type("Pursuit", (PurePursuit,), {"lookahead": distance})
        for distance in (0.4, 0.6, 0.9, 1.3)
    },
    "regulated pure pursuit": TunedRegulatedPurePursuit,
    "Stanley": TunedStanley,
    "Lapierre-Soetanto": TunedLapierreSoetanto,
    "LQR": Lqr,
}
_SPEEDS = (0.3, 0.5, 0.7, 1.0)
_LONGEST = 20.0  # [s]


class Case:
    """A robot, a path, a speed and a start, drawn by a seed."""

    def __init__(self, seed: int, plant: str = "analytic") -> None:
        """Draw them, for a plant."""
        self._plant = plant
        rng = np.random.default_rng([seed, 3])
        self.robot = random_robot(seed)
        self.path_name = tuple(PATHS)[seed % len(PATHS)]
        self.path: Path = PATHS[self.path_name]()
        self.speed = float(rng.choice(_SPEEDS))
        self._start = rng.uniform([0.0, -0.1, -0.2], [0.0, 0.1, 0.2])

    def settings(self, **values: object) -> Settings:
        """Return the settings of the drive, with some changed."""
        fastest = max(1.0, 1.3 * self.speed)
        return build(Settings, {"desired_speed": self.speed, "max_linear_vel": fastest, **values})

    def plant(self) -> Plant:
        """Return the robot at its start."""
        pose = start_pose(self.path, tuple(self._start))
        if self._plant == "mujoco":
            from mujoco_plant import MujocoPlant

            return MujocoPlant(self.robot, pose)
        return AnalyticPlant(self.robot, pose)

    def outcome(self, name: str) -> Outcome:
        """Return the outcome of a contender."""
        plant = self.plant()
        settings = self.settings(**self._values(name))
        control = (
            peer(PEERS[name], settings, self.path) if name in PEERS else ours(settings, self.path)
        )
        return drive(plant, control, self.path, settings, _LONGEST)

    def _values(self, name: str) -> Mapping[str, object]:
        robot, (gain, turn_gain, bias) = self.robot, self.robot.gains
        servo = 0.01 if self._plant == "mujoco" else 0.0  # [s] that its motors take
        return {
            "ideal": {"robot_model": "ideal"},
            "learned": {"robot_model": "learned"},
            "known": {
                "robot_model": "given",
                "actuation_delay": robot.delay,
                "robot_lags": (robot.lag + servo, robot.lag + servo),
                "robot_ramps": robot.ramps,
                "robot_gains": (gain, turn_gain),
                "robot_bias": bias,
            },
        }.get(name, {})


def table(found: Mapping[str, Mapping[str, list[float]]]) -> str:
    """Return shares of the robots on which each of ours is best, and its distances."""
    seeds = [seed for seed, row in found.items() if any(name in PEERS for name in row)]
    if not seeds:
        return "no peer was driven to compare with"
    lines = [
        "| contender | best in J | best in RMS | best in both | worst J | worst RMS | "
        "median RMS [mm] | p90 | worst | variation |",
        "|---|" + "---|" * 9,
    ]
    best = {
        seed: np.min([found[seed][name][:2] for name in PEERS if name in found[seed]], axis=0)
        for seed in seeds
    }
    rows: dict[str, np.ndarray] = {}
    for name in ("ideal", "learned", "known"):
        have = [seed for seed in seeds if name in found[seed]]
        if not have:
            continue
        ratio = np.array([np.array(found[seed][name][:2]) / best[seed] for seed in have])
        good = ratio <= 1.0
        distance = 1e3 * np.array([found[seed][name][1] for seed in have])
        variation = np.median([found[seed][name][2] for seed in have])
        shares = [good[:, 0].mean(), good[:, 1].mean(), good.all(axis=1).mean()]
        cells = [f"{100 * share:.0f} %" for share in shares]
        cells += [f"{value:.2f}" for value in ratio.max(axis=0)]
        cells += [f"{np.median(distance):.1f}", f"{np.quantile(distance, 0.9):.1f}"]
        cells += [f"{distance.max():.0f}", f"{variation:.2f}"]
        lines.append(f"| {name} ({len(have)}) | " + " | ".join(cells) + " |")
        rows[name] = ratio
    distance = 1e3 * np.array([value[1] for value in best.values()])
    lines.append(
        f"| best peer | | | | | | {np.median(distance):.1f} | "
        f"{np.quantile(distance, 0.9):.1f} | {distance.max():.0f} | |"
    )
    return "\n".join(lines)


def main() -> None:
    """Run what the cache lacks, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--plant", choices=("analytic", "mujoco"), default="analytic")
    parser.add_argument("--contenders", default="ideal,learned,known,peers")
    parser.add_argument("--cache", type=FilePath, default=None)
    options = parser.parse_args()
    names: list[str] = []
    for name in options.contenders.split(","):
        names += PEERS if name == "peers" else [name]
    found: dict[str, dict[str, list[float]]] = {}
    if options.cache is not None and options.cache.exists():
        found = json.loads(options.cache.read_text())
    for seed in range(options.first, options.first + options.robots):
        row = found.setdefault(str(seed), {})
        case = Case(seed, options.plant)
        for name in names:
            if name not in row:
                outcome = case.outcome(name)
                row[name] = [outcome.cost, outcome.rms, outcome.variation]
        if options.cache is not None:
            options.cache.write_text(json.dumps(found))
        best = np.min([row[name][:2] for name in PEERS if name in row] or [[math.nan] * 2], axis=0)
        shown = {name: [round(v, 4) for v in row[name]] for name in row if name not in PEERS}
        print(seed, case.path_name, case.speed, "peer", best.round(4).tolist(), shown, flush=True)
    print(table(found))


if __name__ == "__main__":
    main()
