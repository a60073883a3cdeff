"""A plant on MuJoCo, independent of the package's model: contact, slip, payload, motor torque.

A chassis on two driven wheels, and casters without friction before and behind them. The wheels are
spheres: each touches the floor in one point, so that track and radius are those of the drawing.
Delay and ramp are the firmware's (`plants.Firmware`); a first-order filter of the set speed has the
lag; the motor follows it as its torque and the load allow. The pose is that of the axle's middle.

    python bench/robots/mujoco_plant.py    # compares the plant with closed forms
"""

from __future__ import annotations

import math
from dataclasses import replace

import mujoco
import numpy as np
from plants import STEP, Firmware, Odometry, Sensors
from robots import Robot

from adp_path_follower.core.geometry import FloatArray

SERVO = 0.01  # [s] in which a motor with enough torque brings the robot to the set speed
_ROTOR = 0.2  # inertia of a geared rotor, as a share of the mass at the rim
_USUAL_MASS = 8.0  # [kg]
_STRENGTH = 8.0  # [m/s^2] that the motors can give to _USUAL_MASS
_WHEEL_MASS = 0.02  # share of each wheel in the mass
_HEIGHT = 0.04  # [m] of the chassis' centre of mass
_BEHIND = 0.03  # share of the track by which it is behind the axle


def _drawing(robot: Robot) -> str:
    """Return the robot in MuJoCo's format."""
    half = 0.5 * robot.track * (1.0 + robot.track_error)
    scale = robot.wheel_radius * (1.0 + robot.radius_error)
    left = scale * (1.0 - 0.5 * robot.wheel_difference)
    right = scale * (1.0 + 0.5 * robot.wheel_difference)
    mass = robot.mass * (1.0 - 2.0 * _WHEEL_MASS)
    wheel, behind = robot.mass * _WHEEL_MASS, _BEHIND * robot.track
    turning = mass * (0.35 * robot.track) ** 2
    caster = 0.4 * robot.wheel_radius
    reach = 0.45 * robot.track
    rotor = _ROTOR * robot.mass * scale**2
    gain = (0.5 * robot.mass * scale**2 + rotor) / SERVO
    torque = _USUAL_MASS * _STRENGTH * robot.wheel_radius / 2.0
    lag = f'dyntype="filterexact" dynprm="{robot.lag}"' if robot.lag > 0.0 else 'dyntype="none"'

    def driven(name: str, radius: float, y: float) -> str:
        return f"""
        <body name="{name}" pos="0 {y} {radius - scale}">
          <joint name="{name}" type="hinge" axis="0 1 0" armature="{rotor}"/>
          <geom type="sphere" size="{radius}" friction="{robot.friction} 0 0" priority="1"
            mass="{wheel}" condim="3"/>
        </body>"""

    def motor(name: str) -> str:
        return f"""
        <general name="{name}" joint="{name}" {lag} gainprm="{gain}" biastype="affine"
          biasprm="0 0 {-gain}" forcerange="{-torque} {torque}" forcelimited="true"/>"""

    return f"""
    <mujoco>
      <option timestep="{STEP}" cone="elliptic" impratio="100" integrator="Euler"/>
      <default><geom solref="0.004 1" solimp="0.999 0.9999 0.00001"/></default>
      <worldbody>
        <geom type="plane" size="0 0 1" friction="1 0 0"/>
        <body name="chassis" pos="0 0 {scale}">
          <freejoint/>
          <inertial pos="{-behind} 0 {_HEIGHT - scale}" mass="{mass}"
            diaginertia="{turning} {turning} {turning}"/>
          <geom type="sphere" size="{caster}" pos="{-reach} 0 {caster - scale}" condim="1"
            priority="2" mass="0"/>
          <geom type="sphere" size="{caster}" pos="{reach} 0 {caster - scale + 0.0002}" condim="1"
            priority="2" mass="0"/>
          {driven("left", left, half)}{driven("right", right, -half)}
        </body>
      </worldbody>
      <actuator>{motor("left")}{motor("right")}</actuator>
    </mujoco>"""


class MujocoPlant:
    """A robot in MuJoCo."""

    def __init__(self, robot: Robot, pose: FloatArray) -> None:
        """Start at rest at a pose (3,)."""
        self.robot, self.time = robot, 0.0
        self._model = mujoco.MjModel.from_xml_string(_drawing(robot))
        self._data = mujoco.MjData(self._model)
        x, y, theta = np.asarray(pose, float).tolist()
        self._data.qpos[:2] = x, y
        self._data.qpos[3:7] = math.cos(0.5 * theta), 0.0, 0.0, math.sin(0.5 * theta)
        for _ in range(200):  # until it stands on its wheels
            mujoco.mj_step(self._model, self._data)
        self._angles = self._data.qpos[7:9].copy()
        self._look()
        self._firmware, self._sensors = Firmware(robot), Sensors(robot, self.pose)
        self._sensors.step(0.0, self.pose, (0.0, 0.0))

    def _look(self) -> None:
        q, v = self._data.qpos, self._data.qvel
        theta = math.atan2(2.0 * (q[3] * q[6] + q[4] * q[5]), 1.0 - 2.0 * (q[5] ** 2 + q[6] ** 2))
        self.pose = np.array([q[0], q[1], theta])
        self.twist = np.array([math.cos(theta) * v[0] + math.sin(theta) * v[1], v[5]])

    def step(self, command: FloatArray) -> None:
        """Move for `STEP` while a command (2,) is being sent."""
        robot, data = self.robot, self._data
        rims = self._firmware.step(command)
        data.ctrl[0], data.ctrl[1] = rims[0] / robot.wheel_radius, rims[1] / robot.wheel_radius
        mujoco.mj_step(self._model, data)
        self.time += STEP
        self._look()
        left, right = (data.qpos[7:9] - self._angles) * (robot.wheel_radius / STEP)
        self._angles = data.qpos[7:9].copy()
        encoders = 0.5 * float(left + right), float(right - left) / robot.track
        self._sensors.step(self.time, self.pose, encoders)

    @property
    def wheel_angles(self) -> FloatArray:
        """Return how far the left and the right wheel have turned [rad]."""
        return self._angles

    def arrived(self) -> list[Odometry]:
        """Return the odometry that has arrived since the last call."""
        return self._sensors.arrived(self.time)


def driven(plant: MujocoPlant, command: tuple[float, float], time: float) -> FloatArray:
    """Return pose, true v and w, and wheel angles of each step with one command, shape (N, 7)."""
    rows = []
    for _ in range(round(time / STEP)):
        plant.step(np.array(command))
        rows.append([*plant.pose, *plant.twist, *plant.wheel_angles])
    return np.array(rows)


def main() -> None:
    """Print how far the plant is from closed forms."""
    robot = Robot(radius_error=-0.02, track_error=0.03, wheel_difference=0.01, lag=0.1, mass=12.0)
    for friction in (0.9, 0.3):
        robot = replace(robot, friction=friction)
        (gain, turn_gain, bias), scale = robot.gains, robot.wheel_radius * (1 + robot.radius_error)
        plant = MujocoPlant(robot, np.zeros(3))
        still, rows = driven(plant, (0.0, 0.0), 5.0), driven(plant, (0.5, 0.0), 8.0)
        print(f"friction {friction}: at rest for 5 s it creeps {1e6 * abs(still[-1, 0]):.2f} um")
        left, right = (rows[-1, 5:] - still[-1, 5:]) * scale * [0.995, 1.005]
        turn = (right - left) / (robot.track * (1.0 + robot.track_error))
        chord = 0.5 * (left + right) * math.sin(0.5 * turn) / (0.5 * turn)
        x, y, heading = (rows[-1] - still[-1])[:3]
        print(f"  straight: {math.hypot(x, y):.5f} m, {chord:.5f} by the wheels; ")
        print(f"  turned {heading:.5f} rad, {turn:.5f} by the wheels")
        answer = np.searchsorted(rows[:, 3], (1.0 - math.exp(-1.0)) * gain * 0.5) * STEP
        print(f"  63 % of v after {answer:.3f} s, {robot.lag + SERVO:.3f} by its lags")
        for v, w in ((0.5, 0.5), (1.0, 1.0), (0.3, 1.5)):
            rows = driven(MujocoPlant(robot, np.zeros(3)), (v, w), 20.0)[3000:]
            known = np.column_stack([2.0 * rows[:, :2], np.ones(len(rows))])
            solved = np.linalg.lstsq(known, (rows[:, :2] ** 2).sum(axis=1), rcond=None)[0]
            radius = math.sqrt(solved[2] + solved[0] ** 2 + solved[1] ** 2)
            left, right = (rows[-1, 5:] - rows[0, 5:]) * robot.wheel_radius
            seen, turned = 0.5 * (left + right), (right - left) / robot.track
            expected = gain * seen / (turn_gain * turned + bias * seen)
            print(f"  circle {v}, {w}: radius {radius:.4f} m, {expected:.4f} by the encoders")


if __name__ == "__main__":
    main()
