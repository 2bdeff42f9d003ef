"""The 15-state filter on robot_localization's own bag of a Jackal: its last position lies within the tolerance that project publishes.

Position, tolerance, inputs and process noise are those of its test/test_ukf_localization_node_bag2.{cpp,launch} (BSD-3): no GNSS,
gravity removed by the IMU's own attitude, the first measurement of a state is its first value, P0 = 1e-9 I.
"""

import numpy as np
from rosbags.highlevel import AnyReader
from shared_data import shared_data

from tcpipe.fusion.state import GRAVITY_MPS2
from tcpipe.fusion.ukf15 import AX, AY, AZ, PITCH, ROLL, VX, VY, VZ, WX, WY, WZ, YAW, SensorRows, filter_forward
from tcpipe.geometry.rotation import invert, multiply, quat_from_rpy, rotate, rpy_from_quat

VELOCITY, TURN, ACCELERATION = (VX, VY, VZ), (WX, WY, WZ), (AX, AY, AZ)


def _messages(reader, type_name):
    for connection, _, raw in reader.messages([c for c in reader.connections if c.msgtype == type_name]):
        yield reader.deserialize(raw, connection.msgtype)


def _stamp_ns(message):
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


def _xyz(vector):
    return vector.x, vector.y, vector.z


def _odometry(reader, entries):
    """Body twist: `entries` are the states measured, of VELOCITY and TURN."""
    stamp_ns, z, variance = [], [], []
    columns = [entry - VELOCITY[0] for entry in entries]
    for message in _messages(reader, "nav_msgs/msg/Odometry"):
        twist = message.twist.twist
        stamp_ns.append(_stamp_ns(message))
        z.append(np.array([*_xyz(twist.linear), *_xyz(twist.angular)])[columns])
        variance.append(np.diag(message.twist.covariance.reshape(6, 6))[columns])
    return SensorRows("wheel_odometry", tuple(entries), np.array(stamp_ns), np.array(z), np.array(variance))


def _imu(reader, base_from_imu, turn_entries):
    """Attitude, angular velocity and acceleration less gravity, in base_link."""
    stamp_ns, quat, turn, force, variances = [], [], [], [], []
    for message in _messages(reader, "sensor_msgs/msg/Imu"):
        q = message.orientation
        stamp_ns.append(_stamp_ns(message))
        quat.append((q.x, q.y, q.z, q.w))
        turn.append(_xyz(message.angular_velocity))
        force.append(_xyz(message.linear_acceleration))
        variances.append(
            [
                np.diag(c.reshape(3, 3))
                for c in (
                    message.orientation_covariance,
                    message.angular_velocity_covariance,
                    message.linear_acceleration_covariance,
                )
            ]
        )
    stamp_ns, variances = np.array(stamp_ns), np.array(variances)
    acceleration = rotate(base_from_imu, force - rotate(invert(quat), [0.0, 0.0, GRAVITY_MPS2]))
    attitude = rpy_from_quat(multiply(quat, invert(base_from_imu)))
    turn = rotate(base_from_imu, turn)
    columns = [entry - TURN[0] for entry in turn_entries]
    return (
        SensorRows("imu", (ROLL, PITCH, YAW), stamp_ns, attitude, variances[:, 0]),
        SensorRows("imu", tuple(turn_entries), stamp_ns, turn[:, columns], variances[:, 1][:, columns]),
        SensorRows("imu", ACCELERATION, stamp_ns, acceleration, variances[:, 2]),
    )


def _last_position(sources, q):
    x, P = np.zeros(15), 1e-9 * np.eye(15)
    for source in sources:
        x[list(source.entries)] = source.z[0]
    start_ns = min(source.stamp_ns[0] for source in sources)
    end_ns = max(source.stamp_ns[-1] for source in sources)
    order = [np.argsort(source.stamp_ns, kind="stable") for source in sources]
    assert all((np.diff(at) == 1).all() for at in order)
    found = filter_forward(
        sources,
        [np.inf] * len(sources),
        x=x,
        P=P,
        q=np.array(q),
        start_ns=start_ns,
        output_ns=np.array([end_ns]),
    )
    return found.x[0, :3]


def test_jackal_50_hz():
    with AnyReader([shared_data("robot_localization/test2.bag")]) as reader:
        level = quat_from_rpy(0.0, 0.0, 0.0)
        sources = (*_imu(reader, level, TURN), _odometry(reader, (*VELOCITY, TURN[2])))
    q = [0.03, 0.03, 0.4, 0.03, 0.03, 0.06, 0.025, 0.025, 0.05, 0.002, 0.002, 0.004, 0.01, 0.01, 0.01]
    distance = np.linalg.norm(_last_position(sources, q) - [1.0438, 3.4940, 0.7260])
    assert distance < 0.2351
