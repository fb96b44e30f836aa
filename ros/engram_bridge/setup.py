"""Installs the bridge: colcon build --packages-select engram_msgs engram_bridge."""

from glob import glob

from setuptools import setup

NAME = "engram_bridge"

setup(
    name=NAME,
    version="0.2.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/" + NAME]),
        ("share/" + NAME, ["package.xml"]),
        ("share/" + NAME + "/launch", glob("launch/*.launch.py")),
        ("share/" + NAME + "/config", glob("config/*")),
    ],
    install_requires=["setuptools", "numpy"],
    zip_safe=True,
    license="Apache-2.0",
    entry_points={"console_scripts": ["bridge = engram_bridge.node:main"]},
)
