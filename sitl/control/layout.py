"""Layout of the flat arrays of the compiled control loops.

Passing a flat float64 array to compiled code takes 0.25 us, a record several times that.
"""

from __future__ import annotations

# Setpoint (11,): NED, m, m/s, m/s^2, rad, rad/s; NaN means not controlled.
SP_POSITION = 0
SP_VELOCITY = 3
SP_ACCELERATION = 6
SP_YAW = 9
SP_YAW_RATE = 10
SETPOINT_SIZE = 11

# Measurement (14,)
M_POSITION = 0  # NED, m
M_VELOCITY = 3  # NED, m/s
M_QUATERNION = 6  # w x y z, body FRD -> NED
M_RATES = 10  # body FRD, rad/s
M_ON_GROUND = 13  # 0 or 1
MEASUREMENT_SIZE = 14

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

# Gains (n,), filled by sitl.control.gains
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
