"""The firmware's cascaded PID and a drone, in plain Python: nothing of the library, and nothing shared with it.

Written from the published description of the firmware's loops and the paper's equations, one scalar loop after the
other: angles in degrees, pitch nose up, thrust in counts of 65535, set-point of velocity in the frame of the heading.
The drone is integrated by SciPy (DOP853) with rotation matrices instead of quaternions.
"""

import math

import numpy as np
from scipy.integrate import solve_ivp

FULL = 65535
TICK = 0.002


class Loop:
    """One channel: P on the error, I with a limit, D on what is measured."""

    def __init__(self, p, i=0.0, d=0.0, store=5000.0, most=math.inf, dt=TICK, angle=False):
        self.p, self.i, self.d, self.store, self.most, self.dt, self.angle = p, i, d, store, most, dt, angle
        self.sum, self.before = 0.0, None

    def __call__(self, wanted, measured):
        error = wanted - measured
        change = 0.0 if self.before is None else measured - self.before
        if self.angle:
            error, change = (math.remainder(x, 360.0) for x in (error, change))
        self.before = measured
        self.sum = min(max(self.sum + error * self.dt, -self.store), self.store)
        out = self.p * error + self.i * self.sum - self.d * change / self.dt
        return min(max(out, -self.most), self.most)


class Firmware:
    """CF21BL's defaults; called at 500 Hz with position [m], velocity [m/s], attitude [deg], rate [deg/s]."""

    def __init__(self, base):
        slow = 5 * TICK
        self.base, self.tick = base, 0
        self.x, self.y = (Loop(2.0, most=1.1, dt=slow) for _ in "xy")
        self.z = Loop(2.0, 0.5, most=1.1, dt=slow)
        self.vx, self.vy = (Loop(25.0, 1.0, most=22.0, dt=slow) for _ in "xy")
        self.vz = Loop(25.0, 15.0, most=32.767, dt=slow)
        self.roll, self.pitch = (Loop(6.0, 3.0, store=20.0) for _ in range(2))
        self.yaw = Loop(6.0, 1.0, 0.35, store=360.0, angle=True)
        self.p, self.q = (Loop(200.0, 400.0, 2.5, store=33.3, most=32767.0) for _ in range(2))
        self.r = Loop(120.0, 16.7, store=166.7, most=32767.0)

    def __call__(self, goal, yaw_goal, position, velocity, roll, pitch, yaw, rates):
        if self.tick % 5 == 0:
            c, s = math.cos(math.radians(yaw)), math.sin(math.radians(yaw))

            def ahead(v):
                return v[0] * c + v[1] * s, v[1] * c - v[0] * s

            (gx, gy), (px, py), (ux, uy) = ahead(goal), ahead(position), ahead(velocity)
            forward = self.vx(self.x(gx, px), ux)
            left = self.vy(self.y(gy, py), uy)
            up = self.vz(self.z(goal[2], position[2]), velocity[2])
            self.want_roll = max(-20.0, min(20.0, -left))
            self.want_pitch = max(-20.0, min(20.0, -forward))
            self.thrust = max(20000.0, min(FULL, 1000.0 * up + self.base))
        self.tick += 1
        roll_out = self.p(self.roll(self.want_roll, roll), rates[0])
        pitch_out = self.q(self.pitch(self.want_pitch, pitch), rates[1])
        yaw_out = self.r(self.yaw(yaw_goal, yaw), rates[2])
        # X configuration, motors front right, back right, back left, front left; the firmware turns yaw's sign first.
        r, p, y = roll_out / 2, pitch_out / 2, -yaw_out
        motors = [self.thrust - r + p + y, self.thrust - r - p - y, self.thrust + r - p + y, self.thrust + r + p - y]
        above = max(0.0, max(motors) - FULL)
        return [max(7000.0, m - above) / FULL for m in motors]


class Drone:
    """Paper eqs. 1 to 10 with a rotation matrix, by SciPy."""

    def __init__(self, p):
        """``p``: parameters as a dict of floats and arrays."""
        self.p = p

    def slope(self, _, x, u):
        p = self.p
        v, matrix, w, speed = x[3:6], x[6:15].reshape(3, 3), x[15:18], x[18:22]
        acceleration = (p["gain"] * u + p["offset"] - speed) / p["lag"]
        thrust, torque = p["thrust"](speed), p["torque"](speed)
        half = p["spacing"] / 2
        turn = np.array(
            [
                half * (-thrust[0] - thrust[1] + thrust[2] + thrust[3]),
                half * (-thrust[0] + thrust[1] + thrust[2] - thrust[3]),
                np.dot([-1, 1, -1, 1], torque + p["rotor_inertia"] * acceleration),
            ]
        )
        spin = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        fall = matrix[:, 2] * thrust.sum() / p["mass"] - [0, 0, p["gravity"]]
        turning = (turn - np.cross(w, p["inertia"] * w)) / p["inertia"]
        return np.concatenate([v, fall, (matrix @ spin).ravel(), turning, acceleration])

    def fly(self, x, u, seconds):
        return solve_ivp(self.slope, (0, seconds), x, args=(np.array(u),), method="DOP853", rtol=1e-9, atol=1e-10).y[
            :, -1
        ]


def flight(drone, base, goal, yaw_goal_deg, seconds, delay_ticks):
    """Positions (n, 3) and commands (n, 4) of a flight from hover at the origin; poses are seen late, rates at once."""
    p = drone.p
    x = np.concatenate([np.zeros(6), np.eye(3).ravel(), np.zeros(3), np.full(4, p["hover_speed"])])
    controller, past, positions, commands = Firmware(base), [x] * (delay_ticks + 1), [], []
    for _ in range(round(seconds / TICK)):
        past = [*past[1:], x]
        late = past[0]
        matrix = late[6:15].reshape(3, 3)
        roll = math.degrees(math.atan2(matrix[2, 1], matrix[2, 2]))
        nose_up = math.degrees(math.asin(matrix[2, 0]))
        yaw = math.degrees(math.atan2(matrix[1, 0], matrix[0, 0]))
        rates = [math.degrees(x[15]), -math.degrees(x[16]), math.degrees(x[17])]
        u = controller(goal, yaw_goal_deg, late[:3], late[3:6], roll, nose_up, yaw, rates)
        positions.append(x[:3])
        commands.append(u)
        x = drone.fly(x, u, TICK)
    return np.array(positions), np.array(commands)
