"""The message types that recordings of the suite are read from and written to."""

ODOMETRY, STEERING = "nav_msgs/msg/Odometry", "st_msgs/msg/Steering"
NCOM, WHEEL_SPEEDS, CAN_FRAMES = "st_msgs/msg/Ncom", "st_msgs/msg/WheelSpeeds", "st_msgs/msg/CanFrames"
INS_ON_CAN, INS_STATUS = "st_msgs/msg/InsOnCan", "st_msgs/msg/InsStatus"

# Signals of the CAN table, and the fields of WheelSpeeds they go to.
WHEEL_FIELDS = {"wheel_speed_front_left": "front_left", "wheel_speed_front_right": "front_right",
                "wheel_speed_rear_left": "rear_left", "wheel_speed_rear_right": "rear_right",
                "vehicle_speed": "vehicle_speed"}
