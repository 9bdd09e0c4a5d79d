"""The sensors as a xacro macro, for a robot's URDF."""

from __future__ import annotations

from gtsam_rwhec.export.written_poses import fixed_axis_angles, number
from gtsam_rwhec.rig.calibrated_frames import RigFrames

_XACRO = """\
<?xml version="1.0"?>
<!--
  Calibrated sensors, each a link and a fixed joint. The robot's description, which has the link {parent}, needs:

    <xacro:include filename="rig.urdf.xacro"/>
    <xacro:calibrated_sensors/>                         on {parent}
    <xacro:calibrated_sensors parent="another_link"/>   on another link of the same frame

  A camera's link is its optical frame: z forward, x right, y down.
-->
<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:macro name="calibrated_sensors" params="parent:={parent}">
{sensors}  </xacro:macro>
</robot>
"""


def urdf_xacro(frames: RigFrames) -> str:
    """The text of ``rig.urdf.xacro``: the macro ``calibrated_sensors``, on the sensors' carrier by default."""
    sensors = []
    for name, T in frames.sensors.items():
        xyz = " ".join(number(value) for value in T[:3, 3])
        rpy = " ".join(number(value) for value in fixed_axis_angles(T))
        sensors.append(
            f'    <link name="{name}"/>\n'
            f'    <joint name="{name}_joint" type="fixed">\n'
            '      <parent link="${parent}"/>\n'
            f'      <child link="{name}"/>\n'
            f'      <origin xyz="{xyz}" rpy="{rpy}"/>\n'
            "    </joint>\n"
        )
    return _XACRO.format(parent=frames.sensor_carrier, sensors="".join(sensors))
