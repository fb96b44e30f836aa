"""Frame logs: the recorded output of front-end and odometry in one SQLite file."""
