"""Definitions of the robots' own messages, for logs that hold their bytes but not their text.

Field for field as their packages define them: husky_msgs (husky/husky), clearpath_platform_msgs 0.2 and later
(clearpathrobotics/clearpath_msgs), jackal_msgs 0.x of ROS 1 (jackal/jackal), warthog_msgs (warthog-cpr/warthog), nmea_msgs
(ros-drivers/nmea_msgs). Constants and comments are left out: they change no byte.
"""

from __future__ import annotations

DEFINITIONS: dict[str, str] = {
    "husky_msgs/msg/HuskyStatus": """\
std_msgs/Header header
uint32 uptime
float64 ros_control_loop_freq
float64 mcu_and_user_port_current
float64 left_driver_current
float64 right_driver_current
float64 battery_voltage
float64 left_driver_voltage
float64 right_driver_voltage
float64 left_driver_temp
float64 right_driver_temp
float64 left_motor_temp
float64 right_motor_temp
uint16 capacity_estimate
float64 charge_estimate
bool timeout
bool lockout
bool e_stop
bool ros_pause
bool no_battery
bool current_limit
""",
    "clearpath_platform_msgs/msg/Power": """\
std_msgs/Header header
int8 shore_power_connected
int8 battery_connected
int8 power_12v_user_nominal
int8 charger_connected
int8 charging_complete
float32[] measured_voltages
float32[] measured_currents
""",
    "jackal_msgs/msg/Power": """\
std_msgs/Header header
int8 shore_power_connected
int8 battery_connected
int8 power_12v_user_nominal
int8 charging_complete
float32[] measured_voltages
float32[] measured_currents
""",
    "jackal_msgs/msg/Status": """\
std_msgs/Header header
string hardware_id
duration mcu_uptime
duration connection_uptime
bool drivers_active
bool driver_external_stop_present
bool driver_external_stop_stopped
float32 measured_battery
float32 measured_12v
float32 measured_5v
float32 drive_current
float32 user_current
float32 computer_current
float32 total_current
float32 total_current_peak
float64 total_power_consumed
""",
    "warthog_msgs/msg/Status": """\
std_msgs/Header header
string hardware_id
duration mcu_uptime
duration connection_uptime
float32 mcu_temperature
bool stop_engaged
float32 measured_battery
float32 measured_48v
float32 measured_24v
float32 measured_12v
float32 current_battery
float32 current_48v
float32 current_24v
float32 current_12v
float32 current_computer
float32 current_battery_peak
float64 total_power_consumed
""",
    "nmea_msgs/msg/Sentence": """\
std_msgs/Header header
string sentence
""",
}
"""Definition texts by type; what they refer to (std_msgs/Header, duration) belongs to every type store."""
