"""ros2 launch gtsam_rwhec_live live.launch.py rig:=/path/rig.yaml folder:=/path/cell"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

ARGUMENTS = {"rig": "rig.yaml", "folder": "cell", "port": "8723", "publish": ""}


def generate_launch_description() -> LaunchDescription:
    """The one node, with the page's port and the topic on which poses are proposed."""
    values = [{name: LaunchConfiguration(name) for name in ARGUMENTS}]
    node = Node(package="gtsam_rwhec_live", executable="live", output="screen", parameters=values)
    return LaunchDescription([*(DeclareLaunchArgument(n, default_value=v) for n, v in ARGUMENTS.items()), node])
