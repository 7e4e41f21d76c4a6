"""The topics of the suite: which node publishes what. Checked against running nodes by test_viewer_files.py."""

MODELS = ("kinematic", "linear", "nonlinear")  # and augmented, where a model file is given
# Topic, type, publisher, what it is. <model>: each model.
TOPICS = (
    ("/ins/odometry", "nav_msgs/msg/Odometry", "oxts_bridge",
     "INS point in the map frame (ENU), body velocities; 100 or 250 Hz"),
    ("/ins/imu", "sensor_msgs/msg/Imu", "oxts_bridge", "accelerations and angular rates, body axes"),
    ("/ins/nav_sat_fix", "sensor_msgs/msg/NavSatFix", "oxts_bridge", "latitude, longitude, ellipsoidal height"),
    ("/ins/velocity", "geometry_msgs/msg/TwistWithCovarianceStamped", "oxts_bridge", "body velocities with accuracy"),
    ("/ins/time_reference", "sensor_msgs/msg/TimeReference", "oxts_bridge", "host time of receipt, and UTC of the INS"),
    ("/ins/status", "st_msgs/msg/InsStatus", "oxts_bridge", "modes, satellites, accuracies; latched"),
    ("/ins/trigger", "st_msgs/msg/Trigger", "oxts_bridge", "event inputs and outputs of the INS"),
    ("/ins/ncom", "st_msgs/msg/Ncom", "oxts_bridge", "every NCOM packet as received"),
    ("/vehicle/steering", "st_msgs/msg/Steering", "canedge_bridge", "steering wheel and road wheel angle, left +"),
    ("/vehicle/wheel_speeds", "st_msgs/msg/WheelSpeeds", "canedge_bridge", "four wheels, m/s"),
    ("/vehicle/ins_on_can", "st_msgs/msg/InsOnCan", "canedge_bridge", "what the INS sends on CAN, to align clocks"),
    ("/can/frames", "st_msgs/msg/CanFrames", "canedge_bridge", "raw frames, with publish_frames"),
    ("/predictor/<model>/path", "nav_msgs/msg/Path", "predictor", "predicted path of the INS point; 10 Hz"),
    ("/predictor/<model>/prediction", "st_msgs/msg/Prediction", "predictor", "the whole trajectory, state at the CG"),
    ("/predictor/status", "st_msgs/msg/PredictorStatus", "predictor", "tick counts and why one was skipped; latched"),
    ("/evaluator/errors", "st_msgs/msg/PredictionError", "evaluator", "scores, forecast and hindsight"),
    ("/evaluator/summary", "st_msgs/msg/ErrorSummary", "evaluator", "running statistics; latched"),
    ("/identifier/parameters", "st_msgs/msg/TrackedParameters", "identifier",
     "steering and stiffness tracked while driving; latched, never applied"),
    ("/view/markers", "visualization_msgs/msg/MarkerArray", "markers", "car, track, ghosts, errors, names; 10 Hz"),
    ("/view/bands", "visualization_msgs/msg/MarkerArray", "markers",
     "90 % and 50 % bands of the newest predictions, a namespace per model; with a bands file only"),
    ("/view/<model>/error", "geometry_msgs/msg/Vector3Stamped", "markers",
     "mean error of a forecast: x longitudinal, y lateral [m], z yaw [rad]"),
    ("/tf", "tf2_msgs/msg/TFMessage", "oxts_bridge", "odom -> base_link"),
    ("/tf_static", "tf2_msgs/msg/TFMessage", "oxts_bridge", "map -> odom, base_link -> ins_link; latched"),
    ("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", "all", "named checks of every node, once a second"),
)
