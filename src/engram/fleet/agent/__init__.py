"""The robot's side of the centre: offline first."""
