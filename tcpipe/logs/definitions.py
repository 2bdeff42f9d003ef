"""Definitions of the robots' own messages, for logs that hold their bytes but not their text.

Field for field as their packages define them: husky_msgs (husky/husky), clearpath_platform_msgs 0.2 and later
(clearpathrobotics/clearpath_msgs), jackal_msgs 0.x of ROS 1 (jackal/jackal), warthog_msgs (warthog-cpr/warthog), nmea_msgs
(ros-drivers/nmea_msgs), husarion_ugv_msgs (husarion/husarion_ugv_ros), panther_msgs (husarion/panther_msgs), unitree_go
(unitreerobotics/unitree_ros2), vesc_msgs of ROS 2 (f1tenth/vesc), scout_msgs of ROS 2 (agilexrobotics/scout_ros2); their licences stand
in NOTICE. Constants and comments are left out: they change no byte.
"""

from __future__ import annotations

# What husarion_ugv_msgs took over from panther_msgs as it was.
_FAULT_FLAG = """\
bool overheat
bool overvoltage
bool undervoltage
bool short_circuit
bool emergency_stop
bool motor_or_sensor_setup_fault
bool mosfet_failure
bool default_config_loaded_at_startup
"""
_SCRIPT_FLAG = """\
bool loop_error
bool encoder_disconnected
bool amp_limiter
"""
_RUNTIME_ERROR = """\
bool amps_limit_active
bool motor_stall
bool loop_error
bool safety_stop_active
bool forward_limit_triggered
bool reverse_limit_triggered
bool amps_trigger_activated
"""

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
    "husarion_ugv_msgs/msg/RobotDriverState": """\
std_msgs/Header header
husarion_ugv_msgs/DriverStateNamed[] driver_states
bool error
bool write_pdo_cmds_error
bool read_pdo_motor_states_error
bool read_pdo_driver_state_error
""",
    "husarion_ugv_msgs/msg/DriverStateNamed": """\
string name
husarion_ugv_msgs/DriverState state
""",
    "husarion_ugv_msgs/msg/DriverState": """\
float32 voltage
float32 current
float32 temperature
float32 heatsink_temperature
husarion_ugv_msgs/FaultFlag fault_flag
husarion_ugv_msgs/ScriptFlag script_flag
husarion_ugv_msgs/RuntimeError channel_1_motor_runtime_error
husarion_ugv_msgs/RuntimeError channel_2_motor_runtime_error
bool motor_states_data_timed_out
bool driver_state_data_timed_out
bool can_error
bool heartbeat_timeout
""",
    "husarion_ugv_msgs/msg/FaultFlag": _FAULT_FLAG,
    "husarion_ugv_msgs/msg/ScriptFlag": _SCRIPT_FLAG,
    "husarion_ugv_msgs/msg/RuntimeError": _RUNTIME_ERROR,
    "panther_msgs/msg/DriverState": """\
std_msgs/Header header
panther_msgs/MotorControllerState front
panther_msgs/MotorControllerState rear
bool error
bool write_pdo_cmds_error
bool read_pdo_motor_states_error
bool read_pdo_driver_state_error
""",
    "panther_msgs/msg/MotorControllerState": """\
float32 voltage
float32 current
float32 temperature
float32 heatsink_temperature
panther_msgs/FaultFlag fault_flag
panther_msgs/ScriptFlag script_flag
panther_msgs/RuntimeError left_motor_runtime_error
panther_msgs/RuntimeError right_motor_runtime_error
bool motor_states_data_timed_out
bool driver_state_data_timed_out
bool can_error
bool heartbeat_timeout
""",
    "panther_msgs/msg/FaultFlag": _FAULT_FLAG,
    "panther_msgs/msg/ScriptFlag": _SCRIPT_FLAG,
    "panther_msgs/msg/RuntimeError": _RUNTIME_ERROR,
    "unitree_go/msg/LowState": """\
uint8[2] head
uint8 level_flag
uint8 frame_reserve
uint32[2] sn
uint32[2] version
uint16 bandwidth
IMUState imu_state
MotorState[20] motor_state
BmsState bms_state
int16[4] foot_force
int16[4] foot_force_est
uint32 tick
uint8[40] wireless_remote
uint8 bit_flag
float32 adc_reel
int8 temperature_ntc1
int8 temperature_ntc2
float32 power_v
float32 power_a
uint16[4] fan_frequency
uint32 reserve
uint32 crc
""",
    "unitree_go/msg/IMUState": """\
float32[4] quaternion
float32[3] gyroscope
float32[3] accelerometer
float32[3] rpy
int8 temperature
""",
    "unitree_go/msg/MotorState": """\
uint8 mode
float32 q
float32 dq
float32 ddq
float32 tau_est
float32 q_raw
float32 dq_raw
float32 ddq_raw
int8 temperature
uint32 lost
uint32[2] reserve
""",
    "unitree_go/msg/BmsState": """\
uint8 version_high
uint8 version_low
uint8 status
uint8 soc
int32 current
uint16 cycle
int8[2] bq_ntc
int8[2] mcu_ntc
uint16[15] cell_vol
""",
    "unitree_go/msg/SportModeState": """\
TimeSpec stamp
uint32 error_code
IMUState imu_state
uint8 mode
float32 progress
uint8 gait_type
float32 foot_raise_height
float32[3] position
float32 body_height
float32[3] velocity
float32 yaw_speed
float32[4] range_obstacle
int16[4] foot_force
float32[12] foot_position_body
float32[12] foot_speed_body
""",
    "unitree_go/msg/TimeSpec": """\
int32 sec
uint32 nanosec
""",
    "vesc_msgs/msg/VescStateStamped": """\
std_msgs/Header header
VescState state
""",
    "vesc_msgs/msg/VescState": """\
float64 temp_fet
float64 temp_motor
float64 current_motor
float64 current_input
float64 avg_id
float64 avg_iq
float64 duty_cycle
float64 speed
float64 voltage_input
float64 charge_drawn
float64 charge_regen
float64 energy_drawn
float64 energy_regen
int32 displacement
int32 distance_traveled
int32 fault_code
float64 pid_pos_now
int32 controller_id
float64 ntc_temp_mos1
float64 ntc_temp_mos2
float64 ntc_temp_mos3
float64 avg_vd
float64 avg_vq
""",
    "clearpath_platform_msgs/msg/Feedback": """\
std_msgs/Header header
DriveFeedback[2] drivers
int8 commanded_mode
int8 actual_mode
""",
    "clearpath_platform_msgs/msg/DriveFeedback": """\
float32 current
float32 duty_cycle
float32 bridge_temperature
float32 motor_temperature
float32 measured_velocity
float32 measured_travel
bool driver_fault
""",
    "scout_msgs/msg/ScoutStatus": """\
std_msgs/Header header
float64 linear_velocity
float64 angular_velocity
uint8 vehicle_state
uint8 control_mode
uint16 error_code
float64 battery_voltage
ScoutActuatorState[4] actuator_states
bool light_control_enabled
ScoutLightState front_light_state
ScoutLightState rear_light_state
""",
    "scout_msgs/msg/ScoutActuatorState": """\
uint8 motor_id
int16 rpm
float64 current
int32 pulse_count
float32 driver_voltage
float32 driver_temperature
int8 motor_temperature
uint8 driver_state
""",
    "scout_msgs/msg/ScoutLightState": """\
uint8 mode
uint8 custom_value
""",
}
"""Definition texts by type; what they refer to (std_msgs/Header, duration) belongs to every type store."""
