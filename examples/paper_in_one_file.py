"""The paper's method in one file: plain Python and numpy, formula by formula.

P. Walters, R. Kamalapurkar, L. Andrews, W. E. Dixon, "Online Approximate Optimal Path-Following
for a Kinematic Unicycle", arXiv:1310.0064. Run it: `python examples/paper_in_one_file.py [PNG]`.

The robot is at e = [s, y, theta] seen from a virtual target on the path; phi = tanh(k2 s_p) says
where on the path the target is. A critic learns the value function V = Wc . sigma(zeta) of
zeta = [s, y, theta, phi], an actor follows it, and the robot is told u = -1/2 R^-1 g^T sigma'^T Wa.
"""

import sys

import numpy as np

V_DES, K1, K2 = 0.5, 0.1, 0.05  # [m/s], [1/s], [1/m]
Q, R = np.eye(3), np.eye(2)
ETA_C1, ETA_C2, ETA_A = 0.5, 10.0, 5.0  # printed as two eta_c1: the second is eta_c2
WEIGHT_BOUND = 10.0  # of the actor's weights: not printed
START = np.array([-0.5, 0.25, -np.pi / 6.0])  # e(0)
FIRST_WEIGHTS = np.array([0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.5, 0.0, 1.0])
HALF_WIDTHS = [0.5, 0.5, 0.5, 0.5]  # of the sampled region: not printed
PERIOD = 0.01  # [s] of control


def figure_eight():
    """Return the path x = 10 sin p, y = 15 sin 2p as a function of arc length.

    It gives x, y, heading and curvature at arc lengths of any shape. The paper writes the path by
    p, its theory by arc length: |dx/dp| is integrated and inverted here.
    """
    nodes, weights = np.polynomial.legendre.leggauss(6)

    def speed(p):
        return np.hypot(10.0 * np.cos(p), 30.0 * np.cos(2.0 * p))

    def between(first, last):
        middle, half = 0.5 * (first + last), 0.5 * (last - first)
        return half * (speed(middle[..., None] + half[..., None] * nodes) @ weights)

    knots = np.linspace(0.0, 2.0 * np.pi, 2001)
    lengths = np.concatenate([[0.0], np.cumsum(between(knots[:-1], knots[1:]))])

    def path(arc_length):
        rest = np.mod(arc_length, lengths[-1])
        index = np.searchsorted(lengths, rest, side="right") - 1
        p = knots[index] + (rest - lengths[index]) / speed(knots[index])
        for _ in range(4):  # Newton
            p = p - (lengths[index] + between(knots[index], p) - rest) / speed(p)
        dx, dy = 10.0 * np.cos(p), 30.0 * np.cos(2.0 * p)
        ddx, ddy = -10.0 * np.sin(p), -60.0 * np.sin(2.0 * p)
        curvature = (dx * ddy - dy * ddx) / speed(p) ** 3
        return 10.0 * np.sin(p), 15.0 * np.sin(2.0 * p), np.arctan2(dy, dx), curvature

    return path


def target_speed(zeta):
    """Return s_p' = v_des cos(theta) + k1 s."""
    return V_DES * np.cos(zeta[..., 2]) + K1 * zeta[..., 0]


def drift(zeta, curvature):
    """Return f(zeta), shape (..., 4)."""
    s, y, theta, phi = np.moveaxis(zeta, -1, 0)
    along = target_speed(zeta)
    return np.stack(
        [
            curvature * y * V_DES * np.cos(theta) + K1 * curvature * s * y - K1 * s,
            V_DES * np.sin(theta) - curvature * s * V_DES * np.cos(theta) - K1 * curvature * s**2,
            curvature * V_DES - curvature * along,
            K2 * (1.0 - phi**2) * along,
        ],
        axis=-1,
    )


def input_matrix(zeta):
    """Return g(zeta), shape (..., 4, 2)."""
    g = np.zeros((*zeta.shape, 2))
    g[..., 0, 0], g[..., 1, 0], g[..., 2, 1] = np.cos(zeta[..., 2]), np.sin(zeta[..., 2]), 1.0
    return g


# The terms zeta_i zeta_j. The last three are printed as zeta_i, with which u(0) is not zero and
# the robot leaves the path: squares are meant.
TERMS = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3), (0, 0), (1, 1), (2, 2)]


def basis_gradient(zeta):
    """Return sigma'(zeta), shape (..., 9, 4)."""
    gradient = np.zeros((*zeta.shape[:-1], len(TERMS), 4))
    for term, (i, j) in enumerate(TERMS):
        gradient[..., term, i] += zeta[..., j]
        gradient[..., term, j] += zeta[..., i]
    return gradient


def bellman(zeta, curvature, critic, actor):
    """Return input u, Bellman error delta and regressor omega: (..., 2), (...), (..., 9)."""
    gradient, g = basis_gradient(zeta), input_matrix(zeta)
    u = -0.5 * (actor @ (gradient @ g)) @ np.linalg.inv(R)
    omega = np.einsum(
        "...lz,...z->...l", gradient, drift(zeta, curvature) + np.einsum("...zi,...i->...z", g, u)
    )
    e = zeta[..., :3]
    cost = np.einsum("...i,ij,...j->...", e, Q, e) + np.einsum("...i,ij,...j->...", u, R, u)
    return u, cost + omega @ critic, omega


def learned(critic, actor, measured, sampled, period):
    """Return the weights after a period in which errors and regressors (delta, omega) are held.

    Critic: Wc' = -eta_c1 omega delta / p - (eta_c2 / N) sum_j omega_j delta_j / p_j, linear in Wc:
    Wc' = -(A Wc + b). Each eigenvector of A shrinks by 1 / (1 + z + z^2 / 2), z = lambda dt.
    Actor: Wa' = proj{-eta_a (Wa - Wc)}, whose bound the paper's run never meets.
    """
    rate, descent = np.zeros((9, 9)), np.zeros(9)
    for gain, (delta, omega) in ((ETA_C1, measured), (ETA_C2, sampled)):
        delta, omega = np.atleast_1d(delta), np.atleast_2d(omega)
        scaled = omega / np.sqrt(1.0 + (omega**2).sum(axis=-1))[:, None]
        rate += gain / len(delta) * scaled.T @ omega
        descent += gain / len(delta) * delta @ scaled
    z, directions = np.linalg.eigh(period * rate)
    shrunk = (1.0 + 0.5 * z) / (1.0 + z + 0.5 * z**2)  # (1 - 1 / (1 + z + z^2 / 2)) / z
    critic = critic - period * directions @ (shrunk * (directions.T @ descent))
    actor = actor + (1.0 - np.exp(-ETA_A * period)) * (critic - actor)
    assert np.linalg.norm(actor) < WEIGHT_BOUND
    return critic, actor


def error_from(pose, frame):
    """Return e = [s, y, theta] of a pose [x, y, heading] seen from the target's frame."""
    x, y, heading, _ = frame
    dx, dy, cos, sin = pose[0] - x, pose[1] - y, np.cos(heading), np.sin(heading)
    turn = np.mod(pose[2] - heading + np.pi, 2.0 * np.pi) - np.pi
    return np.array([cos * dx + sin * dy, cos * dy - sin * dx, turn])


def run(path, duration=40.0):
    """Return poses, errors, commands and both weights at each step, and the cost J."""
    grid = np.meshgrid(*[np.linspace(-width, width, 3) for width in HALF_WIDTHS], indexing="ij")
    samples = np.stack(grid, axis=-1).reshape(-1, 4)  # 81 states about the origin
    at_samples = path(np.arctanh(samples[:, 3]) / K2)[3]
    critic = actor = FIRST_WEIGHTS
    place, frame = 0.0, path(np.array(0.0))
    x, y, heading, _ = frame
    along, across, turn = START
    cos, sin = np.cos(heading), np.sin(heading)
    pose = np.array(
        [x + cos * along - sin * across, y + sin * along + cos * across, heading + turn]
    )
    error, rows, total, before = error_from(pose, frame), [], 0.0, (0.0, 0.0)
    for step in range(round(duration / PERIOD) + 1):
        if step > 0:  # the target moves on, by Heun's method
            first = target_speed(error)
            guess = place + PERIOD * first
            place += 0.5 * PERIOD * (first + target_speed(error_from(pose, path(np.array(guess)))))
            frame = path(np.array(place))
            error = error_from(pose, frame)
        zeta, curvature = np.append(error, np.tanh(K2 * place)), frame[3]
        u, delta, omega = bellman(zeta, curvature, critic, actor)
        v, w = u + np.array([V_DES, curvature * V_DES])
        rows.append((pose, error, [v, w], critic, actor))
        state_cost, input_cost = error @ Q @ error, u @ R @ u
        if step > 0:
            total += PERIOD * (0.5 * (before[0] + state_cost) + before[1])  # u was held
            sampled = bellman(samples, at_samples, critic, actor)[1:]
            critic, actor = learned(critic, actor, (delta, omega), sampled, PERIOD)
        before = state_cost, input_cost
        half = 0.5 * w * PERIOD  # the robot drives along an arc
        chord, middle = v * PERIOD * np.sinc(half / np.pi), pose[2] + half
        pose = pose + np.array([chord * np.cos(middle), chord * np.sin(middle), 2.0 * half])
    return (*(np.array(column) for column in zip(*rows, strict=True)), total)


def plot(file, errors, weights, cost):
    """Draw errors and critic weights over time."""
    from matplotlib.figure import Figure

    time = PERIOD * np.arange(len(errors))
    figure = Figure(figsize=(8.0, 6.0), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    above.plot(time, errors, label=["s [m]", "y [m]", "θ [rad]"])
    above.set_title(f"J = {cost:.4f} after {time[-1]:g} s")
    below.plot(time, weights, label=["".join("syθφ"[i] for i in term) for term in TERMS])
    below.set(xlabel="time [s]", ylabel="critic weights")
    for axes in (above, below):
        axes.legend(ncols=3)
        axes.grid(visible=True)
    figure.savefig(file)


if __name__ == "__main__":
    _, errors, _, critics, _, cost = run(figure_eight())
    plot(sys.argv[1] if len(sys.argv) > 1 else "paper.png", errors, critics, cost)
    print(f"J = {cost:.6f}, |e| at the end {np.linalg.norm(errors[-1]):.2e}")
