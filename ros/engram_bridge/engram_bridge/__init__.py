"""The bridge between ROS 2 and Engram; needs rclpy, messages and NumPy, on Python 3.8 or newer.

Only `node` imports ROS: everything else is plain Python, and tested as such.
"""
