"""ROS bags as drives: ROS 1, and ROS 2 in SQLite or MCAP."""
