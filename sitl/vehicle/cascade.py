"""The flight controller: one step from setpoint and measurement to motor commands.

setpoint -> velocity -> acceleration -> thrust vector -> body rates -> torque -> motors

A reference model follows the velocity setpoint within the vehicle's capabilities: with limited
acceleration and the lag of the attitude loop. The model's acceleration is fed forward, and the
feedback acts only on the difference between vehicle and model. A setpoint step therefore neither
overshoots nor winds up the integral.

State, measurement and gains are flat arrays. Passing an array to compiled code takes 0.25 us;
passing a record takes several times as long.
"""

from __future__ import annotations

import math

import numpy as np

from mavfi_cli.core.compiled import compiled
from mavfi_cli.core.frames import Vector
from sitl.vehicle.truth import T_ON_GROUND, T_POSITION, T_QUATERNION, T_RATES, T_VELOCITY

# Setpoint (19,): NED, m, m/s, m/s^2, rad, rad/s; NaN means not controlled. With a thrust, a share
# of the largest motor command, the vehicle follows an attitude (body FRD to NED) or body rates,
# and nothing that comes before the thrust.
SP_POSITION, SP_VELOCITY, SP_ACCELERATION = 0, 3, 6
SP_YAW, SP_YAW_RATE = 9, 10
SP_THRUST, SP_ATTITUDE, SP_BODY_RATES = 11, 12, 16  # 1, 4 (w x y z), 3
SETPOINT_SIZE = 19

# A measurement (33,) is the vehicle's truth, in the order of `sitl.vehicle.truth`.

# Controller state (21,)
S_VELOCITY_INTEGRAL = 0  # NED, m/s^2
S_MODEL_VELOCITY = 3  # reference model, NED, m/s
S_MODEL_ACCELERATION = 6  # reference model after the attitude lag, NED, m/s^2
S_RATE_INTEGRAL = 9  # body, rad/s^2
S_LAST_RATES = 12  # body, rad/s
S_HEADING = 15  # reference, rad
S_HEADING_RATE = 16  # reference, rad/s
S_FLYING = 17  # 0 on the ground with idling rotors, 1 flying
S_LAGGED_FORWARD = 18  # acceleration feed-forward after the attitude lag, NED, m/s^2
STATE_SIZE = 21

# Gains (n,), filled by sitl.vehicle.gains
G_DT = 0
G_MASS = 1
G_GRAVITY = 2
G_INERTIA = 3  # 3
G_POSITION_P = 6  # 3: north, east, down
G_MODEL_P = 9  # 3
G_MODEL_LAG = 12  # 3
G_VELOCITY_P = 15  # 3
G_VELOCITY_I = 18  # 3
G_INTEGRAL_LIMIT = 21  # 3
G_ACCELERATION_LIMIT = 24  # 2: horizontal norm, vertical
G_SPEED_LIMIT = 26  # horizontal norm
G_CLIMB_LIMIT = 27
G_DESCENT_LIMIT = 28
G_TILT_TANGENT = 29
G_TILT_P = 30
G_TILT_RATE_LIMIT = 31
G_RATE_P = 32  # 3: roll, pitch, yaw
G_RATE_D = 35  # 3
G_RATE_I = 38  # 3
G_HEADING_P = 41
G_HEADING_MODEL_P = 42
G_YAW_RATE_LIMIT = 43
G_YAW_ACCELERATION = 44
G_ROTOR_THRUST = 45  # maximum of one rotor, N
G_ROTOR_OFFSET = 46  # along each body axis, m
G_TORQUE_PER_THRUST = 47  # m
G_THROTTLE = 48  # 3: constant, linear and quadratic in relative rotor speed
G_DRAG_LINEAR = 51  # 3: 1/s
G_DRAG_QUADRATIC = 54  # 3: 1/m
GAINS_SIZE = 57

FARTHEST_M = 1.0e5
LARGEST_ANGLE_RAD = 1.0e4
LARGEST_INPUT = 1.0e3  # limit of a velocity or acceleration component before the norm's limit

LEAST_LIFT = 0.25  # fraction of gravity; with less lift the attitude is undefined
THRUST_RESERVE = 0.9  # fraction of the maximum thrust; the rest is reserved for attitude
HORIZONTAL_MARGIN = 0.2  # fraction of gravity reserved for horizontal acceleration
UNWINDING_HZ = 2.0  # rate at which an integral unwinds at a limit
RATE_INTEGRAL_LIMIT_RADPS2 = 20.0

LEAST_SHARE = 0.01  # minimum share of a rotor's thrust, which keeps it turning
IDLE_SHARE = 0.01
NEGLIGIBLE_SHARE = 1.0e-12  # smallest divisor

# Rotors in PX4's order for an X frame: front right, rear left, front left, rear right. The first
# two turn counter-clockwise seen from above.
_FORWARD = np.array([1.0, -1.0, 1.0, -1.0])
_RIGHT = np.array([1.0, -1.0, -1.0, 1.0])
_SENSE = np.array([1.0, 1.0, -1.0, -1.0])

LIFT_OFF_MPS = 0.1  # minimum climb setpoint for lift-off


@compiled
def _clip(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


@compiled
def wrap(angle_rad: float) -> float:
    """Wrap an angle in radians into [-pi, pi)."""
    return (angle_rad + math.pi) % (2.0 * math.pi) - math.pi


@compiled
def _finite_or_nan(value: float, limit: float) -> float:
    """Clip `value` to +-limit. Return NaN if it is not finite."""
    return _clip(value, -limit, limit) if math.isfinite(value) else math.nan


@compiled
def _limit_horizontal(vector: Vector, start: int, limit: float) -> None:
    """Limit the norm of vector[start:start + 2] to `limit`, in place. NaN counts as zero."""
    x = vector[start] if math.isfinite(vector[start]) else 0.0
    y = vector[start + 1] if math.isfinite(vector[start + 1]) else 0.0
    norm = math.sqrt(x * x + y * y)
    if norm > limit:
        vector[start] *= limit / norm
        vector[start + 1] *= limit / norm


@compiled
def clean_setpoint(setpoint: Vector, gains: Vector) -> Vector:
    """Return the first part (11,) of a setpoint, limited to what the vehicle can do.

    Velocity is limited to the horizontal speed (norm) and to the climb and descent limits, and
    acceleration and yaw rate to their limits. Yaw is wrapped into [-pi, pi). Values that are not
    finite become NaN.
    """
    clean = np.empty(SP_THRUST)
    for index in range(SP_YAW):  # position, then velocity and acceleration
        limit = FARTHEST_M if index < SP_VELOCITY else LARGEST_INPUT
        clean[index] = _finite_or_nan(setpoint[index], limit)
    _limit_horizontal(clean, SP_VELOCITY, gains[G_SPEED_LIMIT])
    _limit_horizontal(clean, SP_ACCELERATION, gains[G_ACCELERATION_LIMIT])
    down = SP_VELOCITY + 2
    if math.isfinite(clean[down]):
        clean[down] = _clip(clean[down], -gains[G_CLIMB_LIMIT], gains[G_DESCENT_LIMIT])
    down = SP_ACCELERATION + 2
    clean[down] = _finite_or_nan(clean[down], gains[G_ACCELERATION_LIMIT + 1])
    clean[SP_YAW] = wrap(_finite_or_nan(setpoint[SP_YAW], LARGEST_ANGLE_RAD))
    clean[SP_YAW_RATE] = _finite_or_nan(setpoint[SP_YAW_RATE], gains[G_YAW_RATE_LIMIT])
    return clean


@compiled
def velocity_target(clean: Vector, measurement: Vector, gains: Vector) -> Vector:
    """Return the target velocity (3,), NED m/s: gain times position error plus velocity setpoint.

    For an axis with neither position nor velocity, the target is NaN if there is an acceleration,
    which then controls the axis alone, and zero otherwise.
    """
    target = np.empty(3)
    for axis in range(3):
        position = clean[SP_POSITION + axis]
        velocity = clean[SP_VELOCITY + axis]
        if math.isfinite(position):
            error = position - measurement[T_POSITION + axis]
            target[axis] = gains[G_POSITION_P + axis] * error
            if math.isfinite(velocity):
                target[axis] += velocity
        elif math.isfinite(velocity):
            target[axis] = velocity
        elif math.isfinite(clean[SP_ACCELERATION + axis]):
            target[axis] = math.nan
        else:
            target[axis] = 0.0
    _limit_horizontal(target, 0, gains[G_SPEED_LIMIT])
    if math.isfinite(target[2]):
        target[2] = _clip(target[2], -gains[G_CLIMB_LIMIT], gains[G_DESCENT_LIMIT])
    return target


@compiled
def _model_acceleration(target: Vector, clean: Vector, state: Vector, gains: Vector) -> Vector:
    """Return the limited acceleration (3,) of the reference model towards its target, NED m/s^2.

    The velocity error excludes the part of the feed-forward that is delayed by the lag. A
    trajectory with its own acceleration is therefore followed one lag late, without overshoot.
    """
    wanted = np.empty(3)
    for axis in range(3):
        forward = clean[SP_ACCELERATION + axis]
        wanted[axis] = forward if math.isfinite(forward) else 0.0
        lag = gains[G_MODEL_LAG + axis]
        state[S_LAGGED_FORWARD + axis] += (wanted[axis] - state[S_LAGGED_FORWARD + axis]) * (
            gains[G_DT] / (lag + gains[G_DT])
        )
        if math.isfinite(target[axis]):
            reachable = target[axis] - lag * state[S_LAGGED_FORWARD + axis]
            error = reachable - state[S_MODEL_VELOCITY + axis]
            wanted[axis] += gains[G_MODEL_P + axis] * error
    _limit_horizontal(wanted, 0, gains[G_ACCELERATION_LIMIT])
    limit = gains[G_ACCELERATION_LIMIT + 1]
    wanted[2] = _clip(wanted[2], -limit, limit)
    return wanted


@compiled
def _drag(velocity_mps: Vector, axis: int, gains: Vector) -> float:
    """Return the deceleration, m/s^2, from drag and inflow along a NED axis at a velocity (3,)."""
    v: float = velocity_mps[axis]
    slowing: float = gains[G_DRAG_LINEAR + axis] + gains[G_DRAG_QUADRATIC + axis] * abs(v)
    return v * slowing


@compiled
def acceleration_target(
    target: Vector, clean: Vector, measurement: Vector, state: Vector, gains: Vector
) -> Vector:
    """Return the acceleration (3,) that the rotors must give, NED m/s^2, and advance `state`.

    It is the feed-forward of the model's acceleration and of drag, plus P and a limited I of the
    difference between model and vehicle.
    """
    dt = gains[G_DT]
    wanted = _model_acceleration(target, clean, state, gains)
    model = state[S_MODEL_VELOCITY : S_MODEL_VELOCITY + 3]
    total = np.empty(3)
    for axis in range(3):
        measured = measurement[T_VELOCITY + axis]
        if not math.isfinite(target[axis]):
            model[axis] = measured
        error = model[axis] - measured
        total[axis] = wanted[axis] + _drag(model, axis, gains)
        total[axis] += gains[G_VELOCITY_P + axis] * error
        limit = gains[G_INTEGRAL_LIMIT + axis]
        integral = state[S_VELOCITY_INTEGRAL + axis] + dt * gains[G_VELOCITY_I + axis] * error
        state[S_VELOCITY_INTEGRAL + axis] = _clip(integral, -limit, limit)
        total[axis] += state[S_VELOCITY_INTEGRAL + axis]
        share = dt / (gains[G_MODEL_LAG + axis] + dt)
        state[S_MODEL_ACCELERATION + axis] += share * (
            wanted[axis] - state[S_MODEL_ACCELERATION + axis]
        )
        model[axis] += dt * state[S_MODEL_ACCELERATION + axis]
    return total


@compiled
def rotation(measurement: Vector) -> Vector:
    """Return the rotation matrix (3, 3) from body FRD to NED for the measured attitude."""
    return _matrix_of(measurement[T_QUATERNION : T_QUATERNION + 4])


@compiled
def _matrix_of(quaternion: Vector) -> Vector:
    """Return the rotation matrix (3, 3) of a unit quaternion (4,) w x y z."""
    w, x, y, z = quaternion
    matrix = np.empty((3, 3))
    matrix[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    matrix[0, 1] = 2.0 * (x * y - w * z)
    matrix[0, 2] = 2.0 * (x * z + w * y)
    matrix[1, 0] = 2.0 * (x * y + w * z)
    matrix[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    matrix[1, 2] = 2.0 * (y * z - w * x)
    matrix[2, 0] = 2.0 * (x * z - w * y)
    matrix[2, 1] = 2.0 * (y * z + w * x)
    matrix[2, 2] = 1.0 - 2.0 * (x * x + y * y)
    return matrix


@compiled
def specific_force(acceleration: Vector, gains: Vector) -> Vector:
    """Return the thrust per mass (3,), NED m/s^2, that gives an acceleration (3,) within limits.

    The vertical part has priority over all of the horizontal part except for a margin. The
    horizontal part is limited by the tilt limit and by the remaining thrust.
    """
    gravity = gains[G_GRAVITY]
    largest = THRUST_RESERVE * 4.0 * gains[G_ROTOR_THRUST] / gains[G_MASS]
    horizontal = math.sqrt(acceleration[0] ** 2 + acceleration[1] ** 2)
    margin = min(horizontal, HORIZONTAL_MARGIN * gravity)
    highest = math.sqrt(max(largest * largest - margin * margin, 0.0))
    force = np.empty(3)
    force[2] = _clip(acceleration[2] - gravity, -highest, -LEAST_LIFT * gravity)
    room = math.sqrt(max(largest * largest - force[2] * force[2], 0.0))
    allowed = min(-force[2] * gains[G_TILT_TANGENT], room)
    scale = allowed / horizontal if horizontal > allowed else 1.0
    force[0] = acceleration[0] * scale
    force[1] = acceleration[1] * scale
    return force


@compiled
def _unwind(acceleration: Vector, force: Vector, state: Vector, gains: Vector) -> None:
    """Reduce the velocity integrals in `state` that demand more force than the limits allow."""
    for axis in range(3):
        had = force[axis] + (gains[G_GRAVITY] if axis == 2 else 0.0)
        step = gains[G_DT] * UNWINDING_HZ * abs(had - acceleration[axis])
        integral = state[S_VELOCITY_INTEGRAL + axis]
        if integral * (acceleration[axis] - had) > 0.0:
            left = max(abs(integral) - step, 0.0)
            state[S_VELOCITY_INTEGRAL + axis] = math.copysign(left, integral)


@compiled
def tilt_rates(force: Vector, matrix: Vector, gains: Vector) -> Vector:
    """Return the body rates (3,), rad/s, that turn the thrust axis towards a force. Yaw is zero."""
    norm = math.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
    # target down axis in body coordinates
    x = -(matrix[0, 0] * force[0] + matrix[1, 0] * force[1] + matrix[2, 0] * force[2]) / norm
    y = -(matrix[0, 1] * force[0] + matrix[1, 1] * force[1] + matrix[2, 1] * force[2]) / norm
    z = -(matrix[0, 2] * force[0] + matrix[1, 2] * force[1] + matrix[2, 2] * force[2]) / norm
    sine = math.sqrt(x * x + y * y)
    angle = math.atan2(sine, z)
    rate = min(gains[G_TILT_P] * angle, gains[G_TILT_RATE_LIMIT])
    rates = np.zeros(3)
    if sine > 1.0e-12:
        rates[0] = -rate * y / sine
        rates[1] = rate * x / sine
    elif z < 0.0:
        rates[0] = rate
    return rates


@compiled
def _heading_rate(clean: Vector, heading: float, state: Vector, gains: Vector) -> float:
    """Return the yaw rate to command, rad/s around the vertical, and advance the reference."""
    dt = gains[G_DT]
    limit = gains[G_YAW_RATE_LIMIT]
    wanted = clean[SP_YAW_RATE] if math.isfinite(clean[SP_YAW_RATE]) else 0.0
    if math.isfinite(clean[SP_YAW]):
        error = wrap(clean[SP_YAW] - state[S_HEADING])
        brake = math.sqrt(1.6 * gains[G_YAW_ACCELERATION] * abs(error))
        wanted += math.copysign(min(gains[G_HEADING_MODEL_P] * abs(error), brake), error)
    wanted = _clip(wanted, -limit, limit)
    step = dt * gains[G_YAW_ACCELERATION]
    rate: float = state[S_HEADING_RATE]
    rate += _clip(wanted - rate, -step, step)
    state[S_HEADING_RATE] = rate
    state[S_HEADING] = wrap(state[S_HEADING] + dt * rate)
    correction: float = gains[G_HEADING_P] * wrap(state[S_HEADING] - heading)
    return rate + _clip(correction, -limit, limit)


@compiled
def _torque(
    rates_wanted: Vector, measurement: Vector, state: Vector, gains: Vector, yaw_free: bool
) -> Vector:
    """Return the body torque (3,), N m, of the rate loops, and advance their integrals.

    They are PID loops with the derivative of the measurement, scaled by inertia, plus the
    gyroscopic term.
    """
    dt = gains[G_DT]
    angular = np.empty(3)
    for axis in range(3):
        rate = measurement[T_RATES + axis]
        error = rates_wanted[axis] - rate
        derivative = (rate - state[S_LAST_RATES + axis]) / dt
        state[S_LAST_RATES + axis] = rate
        if axis < 2 or yaw_free:
            integral = state[S_RATE_INTEGRAL + axis] + dt * gains[G_RATE_I + axis] * error
            state[S_RATE_INTEGRAL + axis] = _clip(
                integral, -RATE_INTEGRAL_LIMIT_RADPS2, RATE_INTEGRAL_LIMIT_RADPS2
            )
        angular[axis] = gains[G_RATE_P + axis] * error + state[S_RATE_INTEGRAL + axis]
        angular[axis] -= gains[G_RATE_D + axis] * derivative
    p, q, r = measurement[T_RATES : T_RATES + 3]
    ix, iy, iz = gains[G_INERTIA : G_INERTIA + 3]
    result = np.empty(3)
    result[0] = ix * angular[0] + q * r * (iz - iy)
    result[1] = iy * angular[1] + p * r * (ix - iz)
    result[2] = iz * angular[2] + p * q * (iy - ix)
    return result


@compiled
def thrust_shares(collective_n: float, torque_nm: Vector, gains: Vector) -> Vector:
    """Return the thrust of each rotor (4,) as a share of its maximum, within [LEAST_SHARE, 1].

    If the rotors saturate, roll and pitch have priority, then the collective, then yaw.
    """
    unit = 4.0 * gains[G_ROTOR_THRUST]
    arm = unit * gains[G_ROTOR_OFFSET]
    tilting = (_FORWARD * torque_nm[1] - _RIGHT * torque_nm[0]) / arm
    room = 1.0 - LEAST_SHARE
    spread = tilting.max() - tilting.min()
    if spread > room:
        tilting *= room / spread
    base = _clip(collective_n / unit, LEAST_SHARE - tilting.min(), 1.0 - tilting.max())
    shares: Vector = tilting + base
    yawing = _SENSE * torque_nm[2] / (unit * gains[G_TORQUE_PER_THRUST])
    scale = 1.0
    for rotor in range(4):
        if yawing[rotor] > NEGLIGIBLE_SHARE:
            scale = min(scale, (1.0 - shares[rotor]) / yawing[rotor])
        elif yawing[rotor] < -NEGLIGIBLE_SHARE:
            scale = min(scale, (LEAST_SHARE - shares[rotor]) / yawing[rotor])
    shares += max(scale, 0.0) * yawing
    for rotor in range(4):
        shares[rotor] = _clip(shares[rotor], LEAST_SHARE, 1.0)
    return shares


@compiled
def throttle(share: float, gains: Vector) -> float:
    """Return the motor command, in [0, 1], that gives a share of a rotor's maximum static thrust.

    The command is the motor's voltage at the rotor speed of that thrust, relative to the voltage
    at full throttle.
    """
    speed = math.sqrt(share)
    command = gains[G_THROTTLE] + gains[G_THROTTLE + 1] * speed + gains[G_THROTTLE + 2] * share
    return _clip(command, 0.0, 1.0)


@compiled
def _thrust_share(command: float, gains: Vector) -> float:
    """Return the share of a rotor's maximum static thrust for a motor command in [0, 1].

    This is the inverse of `throttle`.
    """
    above = max(command - gains[G_THROTTLE], 0.0)
    linear, quadratic = gains[G_THROTTLE + 1], gains[G_THROTTLE + 2]
    speed: float = 2.0 * above / (linear + math.sqrt(linear * linear + 4.0 * quadratic * above))
    return min(speed * speed, 1.0)


@compiled
def mix(collective_n: float, torque_nm: Vector, gains: Vector) -> Vector:
    """Return the motor commands (4,), in [0, 1], for a collective thrust and a torque (3,)."""
    commands = thrust_shares(collective_n, torque_nm, gains)
    for rotor in range(4):
        commands[rotor] = throttle(commands[rotor], gains)
    return commands


@compiled
def _resting_state(measurement: Vector, matrix: Vector) -> Vector:
    """Return the controller state (21,) of a vehicle on the ground.

    The integrals are zero, and the references are the measured heading, velocity and rates.
    """
    state = np.zeros(STATE_SIZE)
    state[S_HEADING] = math.atan2(matrix[1, 0], matrix[0, 0])
    for axis in range(3):
        state[S_MODEL_VELOCITY + axis] = measurement[T_VELOCITY + axis]
        state[S_LAST_RATES + axis] = measurement[T_RATES + axis]
    return state


@compiled
def _attitude_step(
    state: Vector,
    measurement: Vector,
    matrix: Vector,
    setpoint: Vector,
    gains: Vector,
    on_ground: bool,
) -> tuple[Vector, Vector]:
    """Return what `control_step` returns, for a setpoint with a thrust.

    On the ground, the vehicle idles until the thrust exceeds its weight. The references of the
    velocity loops follow the vehicle, so that these loops can take over.
    """
    command = _clip(setpoint[SP_THRUST], 0.0, 1.0)
    collective = 4.0 * gains[G_ROTOR_THRUST] * _thrust_share(command, gains)
    resting = _resting_state(measurement, matrix)
    if on_ground and collective <= gains[G_MASS] * gains[G_GRAVITY]:
        return resting, np.full(4, throttle(IDLE_SHARE, gains))
    new = state.copy() if state[S_FLYING] > 0.5 else resting
    new[S_FLYING] = 1.0
    new[:S_RATE_INTEGRAL] = resting[:S_RATE_INTEGRAL]
    new[S_LAGGED_FORWARD : S_LAGGED_FORWARD + 3] = 0.0
    rates = np.zeros(3)
    norm = math.sqrt((setpoint[SP_ATTITUDE : SP_ATTITUDE + 4] ** 2).sum())
    if 1.0e-6 < norm < math.inf:
        wanted = _matrix_of(setpoint[SP_ATTITUDE : SP_ATTITUDE + 4] / norm)
        rates = tilt_rates(-wanted[:, 2], matrix, gains)
        clean = np.full(SP_THRUST, math.nan)
        clean[SP_YAW] = math.atan2(wanted[1, 0], wanted[0, 0])
        clean[SP_YAW_RATE] = setpoint[SP_BODY_RATES + 2]
        turn = _heading_rate(clean, math.atan2(matrix[1, 0], matrix[0, 0]), new, gains)
        for axis in range(3):
            rates[axis] += matrix[2, axis] * turn
    else:
        new[S_HEADING], new[S_HEADING_RATE] = resting[S_HEADING], 0.0
        for axis in range(3):
            limit = gains[G_YAW_RATE_LIMIT if axis == 2 else G_TILT_RATE_LIMIT]
            rate = setpoint[SP_BODY_RATES + axis]
            rates[axis] = _clip(rate, -limit, limit) if math.isfinite(rate) else 0.0
    moment = _torque(rates, measurement, new, gains, not on_ground)
    return new, mix(collective, moment, gains)


@compiled
def control_step(
    state: Vector, measurement: Vector, setpoint: Vector, gains: Vector, armed: bool
) -> tuple[Vector, Vector]:
    """Return the next controller state (21,) and the motor commands (4,) in [0, 1].

    The function is pure and does not change `state`. An armed vehicle on the ground
    idles until the setpoint climbs, and idles again after touchdown.
    """
    matrix = rotation(measurement)
    if not armed:
        return _resting_state(measurement, matrix), np.zeros(4)
    on_ground = measurement[T_ON_GROUND] > 0.5
    if math.isfinite(setpoint[SP_THRUST]):
        return _attitude_step(state, measurement, matrix, setpoint, gains, on_ground)
    clean = clean_setpoint(setpoint, gains)
    target = velocity_target(clean, measurement, gains)
    climbing = target[2] < -LIFT_OFF_MPS
    if on_ground and not climbing:
        return _resting_state(measurement, matrix), np.full(4, throttle(IDLE_SHARE, gains))
    new = state.copy() if state[S_FLYING] > 0.5 else _resting_state(measurement, matrix)
    new[S_FLYING] = 1.0
    acceleration = acceleration_target(target, clean, measurement, new, gains)
    force = specific_force(acceleration, gains)
    _unwind(acceleration, force, new, gains)
    rates = tilt_rates(force, matrix, gains)
    heading = math.atan2(matrix[1, 0], matrix[0, 0])
    turn = _heading_rate(clean, heading, new, gains)
    for axis in range(3):
        rates[axis] += matrix[2, axis] * turn
    moment = _torque(rates, measurement, new, gains, not on_ground)
    lift = -(matrix[0, 2] * force[0] + matrix[1, 2] * force[1] + matrix[2, 2] * force[2])
    return new, mix(gains[G_MASS] * max(lift, 0.0), moment, gains)
