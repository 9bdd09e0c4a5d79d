"""The ROS 2 package; gtsam-rwhec itself comes from pip: pip install 'gtsam-rwhec[live]'."""

from setuptools import setup

NAME = "gtsam_rwhec_live"
setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/live.launch.py"]),
    ],
    entry_points={"console_scripts": [f"live = {NAME}.node:main"]},
)
