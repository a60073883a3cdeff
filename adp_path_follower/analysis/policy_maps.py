"""The policy that a run began with and the one it had learned: maps of the turn rate."""

import numpy as np

from adp_path_follower.analysis.recorded_run import Drive
from adp_path_follower.core.control.error_dynamics import feedforward, path_state
from adp_path_follower.core.control.policy import descending_input, saturate
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.drawing.charts import SteeringMap

LEARNED = 0.4  # [s] after the first step, for which the second map is
_DISTANCES = np.linspace(-1.0, 1.0, 41)  # [m]
_ANGLES = np.radians(np.linspace(-90.0, 90.0, 41))


def steering_maps(drive: Drive) -> tuple[SteeringMap, ...]:
    """Return the policy's map at the first recorded step and `LEARNED` later.

    Empty where the bag has no actor weights, or no settings that fit them.
    """
    weights, settings = drive.learner.get("actor_weights"), drive.settings
    if weights is None or settings is None or not len(weights.time):
        return ()
    if weights.values.shape[1] != len(settings.learning.value_basis.labels):
        return ()
    place = int(np.searchsorted(weights.time, weights.time[0] + LEARNED))
    chosen = (0, min(place, len(weights.time) - 1))
    if not np.isfinite(weights.values[list(chosen)]).all():
        return ()
    return tuple(
        SteeringMap(
            _DISTANCES,
            _ANGLES,
            _turn_rates(drive, settings, weights.values[step], float(weights.time[step])),
        )
        for step in chosen
    )


def _turn_rates(drive: Drive, settings: Settings, actor: FloatArray, time: float) -> FloatArray:
    """Return the commanded turn rate [rad/s] at each y and theta, with s = 0, shape (Y, T).

    u = -1/2 R^-1 g^T sigma'^T Wa of equation (2), within the limits, where the robot was then.
    """
    row = min(int(np.searchsorted(drive.odometry.time, time)), len(drive.odometry.time) - 1)
    path = drive.segments[int(drive.segment_of_pose[row])].path
    arc_length = drive.projection.arc_length[row]
    y, theta = np.meshgrid(_DISTANCES, _ANGLES, indexing="ij")
    phi = np.broadcast_to(path_state(arc_length, settings.target), y.shape)
    zeta = np.stack([np.zeros_like(y), y, theta, phi], axis=-1)
    by_s, by_y, by_theta, _ = settings.learning.value_basis.expansion(zeta).slope(actor)
    descent = np.stack([np.cos(theta) * by_s + np.sin(theta) * by_y, by_theta], axis=-1)
    inverse_cost = np.asarray(np.linalg.inv(settings.cost.input_cost_matrix()), float)
    ahead = feedforward(path.curvature(arc_length), settings.target.desired_speed)
    ahead = np.broadcast_to(ahead, descent.shape)
    wanted = saturate(descending_input(descent, inverse_cost), ahead, settings.limits)
    return np.asarray((wanted + ahead)[..., 1])
