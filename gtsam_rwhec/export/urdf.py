"""The sensors as a xacro macro, for a robot's URDF."""

from __future__ import annotations

from gtsam_rwhec.export.written_poses import fixed_axis_angles, number
from gtsam_rwhec.rig.rig_frames import CalibratedFrame, RigFrames

_XACRO = """\
<?xml version="1.0"?>
<!--
  Calibrated sensors, each a link and a fixed joint. The robot's description, which has the link {parent}, needs:

    <xacro:include filename="rig.urdf.xacro"/>
    <xacro:calibrated_sensors/>                         on {parent}
    <xacro:calibrated_sensors parent="another_link"/>   on another link of the same frame
{how}-->
<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:macro name="calibrated_sensors" params="parent:={parent}{params}">
{sensors}  </xacro:macro>
</robot>
"""
_PLAIN = "\n  A camera's link is its optical frame: z forward, x right, y down.\n"
_LINKS = """\
    <xacro:calibrated_sensors optical_frames="true"/>   with the optical frames of {links}

  {links}: the frame of the camera's body, whose optical frame its driver publishes. Without the driver, and without
  a description of the camera that has these links, let the macro write the optical frames. A camera without such a
  link is at its optical frame: z forward, x right, y down.
"""


def urdf_xacro(frames: RigFrames) -> str:
    """The text of ``rig.urdf.xacro``: the macro ``calibrated_sensors``, on the sensors' carrier by default.

    Of a camera with a link it has the link; its optical frame too, where the macro's parameter says so.
    """
    parent = frames.sensor_carrier
    sensors = [_joint(frame, "${parent}") for frame in frames.sensor_frames()]
    how, params = _PLAIN, ""
    if frames.links:
        how = _LINKS.format(links=", ".join(link.name for link in frames.links.values()))
        params = " optical_frames:=false"
        optical = [_joint(frame, frame.parent) for frame in frames.optical_frames()]
        sensors += ['    <xacro:if value="${optical_frames}">\n', *optical, "    </xacro:if>\n"]
    return _XACRO.format(parent=parent, how=how, params=params, sensors="".join(sensors))


def _joint(frame: CalibratedFrame, parent: str) -> str:
    """A frame as a link and the fixed joint to its parent's link."""
    name, T = frame.child, frame.T_parent_child
    xyz = " ".join(number(value) for value in T[:3, 3])
    rpy = " ".join(number(value) for value in fixed_axis_angles(T))
    return (
        f'    <link name="{name}"/>\n'
        f'    <joint name="{name}_joint" type="fixed">\n'
        f'      <parent link="{parent}"/>\n'
        f'      <child link="{name}"/>\n'
        f'      <origin xyz="{xyz}" rpy="{rpy}"/>\n'
        "    </joint>\n"
    )
