"""A controller and a far policy of your own.

As a script:  python examples/own_controller.py
By command:   adp --plugin examples/own_controller.py compare --controllers adp,proportional
              adp --plugin examples/own_controller.py simulate --set wide_region=turn_first
"""

import sys

import numpy as np

import adp_path_follower as adp


class Proportional(adp.PeerController):
    """Drive at v_des and steer against the errors to the side and in heading."""

    def command(self, pose, dt, frame, error):
        """Return [v, w] for robots with errors [s, y, theta], shape (B, 3), shape (B, 2)."""
        v = np.full(len(pose), self.cruising_speed)
        w = frame.curvature * v - 1.0 * error[:, 1] - 2.0 * error[:, 2]
        return np.stack([v, w], axis=-1)


class TurnFirst:
    """Far from the path, head for it at 60 degrees at most, and wait for the heading."""

    def __init__(self, settings):
        """Take the desired speed."""
        self.speed = settings.target.desired_speed

    def modified_input(self, zeta, curvature, feedforward):
        """Return the command less its feedforward for states [s, y, theta, phi], (..., 2)."""
        y, theta = zeta[..., 1], zeta[..., 2]
        off = theta + np.clip(y, -np.pi / 3.0, np.pi / 3.0)
        v = self.speed * np.maximum(np.cos(off), 0.0)
        return np.stack([v, -2.0 * off], axis=-1) - feedforward


adp.register_peer("proportional", Proportional, "Proportional steering at v = v_des")
adp.register_far_policy("turn_first", TurnFirst)


def main(duration: float = 30.0) -> None:
    """Compare the controller with two others, and start far away with the policy."""
    starts = [[0.0, 0.5, 0.0], [0.0, -0.5, 0.5]]
    controllers = ["adp", "lqr", "proportional"]
    print(adp.compare("circle:1.0", controllers=controllers, starts=starts, duration=duration))
    settings = adp.load_settings("default", wide_region="turn_first")
    print(adp.simulate("line", settings, starts=[0.0, 4.0, 2.0], duration=duration))


if __name__ == "__main__":
    main(*map(float, sys.argv[1:]))
