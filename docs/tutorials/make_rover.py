"""Write rover.mcap: the first drive of site-a as a robot without a profile records it (docs/tutorials/your-robot.md)."""

import struct
from pathlib import Path

import polars as pl
from mcap.reader import make_reader
from mcap.writer import Writer

TYPES = """std_msgs/Header header
uint16 bus_mv
int32[2] motors_ma
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
CALLED = {
    "sensors/gps_0/fix": "/rover/top_box",
    "sensors/imu_0/data": "/rover/xsens",
    "platform/odom": "/rover/base_state",
    "zed/zed_node/odom": "/rover/front_eye",
    "platform/cmd_vel": "/rover/stick",
}


def write_rover(out):
    writer, channels = Writer(out), {}
    writer.start()
    with Path("../site-a/field/logs/husky_2023-11-14_a.mcap").open("rb") as log:
        for schema, channel, message in make_reader(log).iter_messages():
            name = CALLED.get(channel.topic.removeprefix("/a200_0000/"))
            if name and name not in channels:
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[name] = writer.register_channel(name, "cdr", known)
            if name:
                writer.add_message(channels[name], message.log_time, message.data, message.publish_time)
    kind = writer.register_schema("rover_msgs/msg/Motors", "ros2msg", TYPES.encode())
    motors = writer.register_channel("/rover/motors", "cdr", kind)
    for row in pl.read_parquet("power/*.parquet").iter_rows(named=True):
        stamp = row["header.stamp.sec"], row["header.stamp.nanosec"]
        _, left_amp, right_amp = row["measured_currents"]
        values = round(1000 * row["measured_voltages"][0]), round(1000 * left_amp), round(1000 * right_amp)
        payload = b"\0\1\0\0" + struct.pack("<iIIBxHii", *stamp, 1, 0, *values)
        writer.add_message(motors, row["log_time_ns"], payload, row["publish_time_ns"])
    writer.finish()


with Path("rover.mcap").open("wb") as out:
    write_rover(out)
