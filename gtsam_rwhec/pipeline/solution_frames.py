"""A solved log as what is exported: frames, cameras, clocks and topics under the rig file's names."""

from __future__ import annotations

from gtsam_rwhec.pipeline.solving_stage import Solved
from gtsam_rwhec.results.verdict import Verdict, judge
from gtsam_rwhec.rig import RigFrames


def frames_of(solved: Solved) -> RigFrames:
    """What the exported files hold; sensors under their frames' names."""
    rig, refined = solved.rig, solved.refined
    judgement = judge(solved.solution, refined, solved.log)
    frame = {name: rig.frame_of(name) for name in rig.sensors}
    offsets = {offset.sensor: offset.offset_s for offset in solved.log.time_offsets}
    return RigFrames(
        sensor_carrier=rig.carriers.sensors,
        target_carrier=rig.carriers.targets,
        sensors={frame[name]: pose.matrix() for name, pose in refined.Y.items()},
        targets={name: pose.matrix() for name, pose in refined.X.items()},
        cameras={frame[name]: camera for name, camera in solved.cameras.items() if name in refined.Y},
        time_offsets_s={frame[name]: value for name, value in offsets.items() if name in refined.Y},
        topics={
            frame[name]: sensor.images
            for name, sensor in rig.sensors.items()
            if sensor.images is not None and name in refined.Y
        },
        warnings=() if judgement.verdict is Verdict.USE else (str(judgement),),
    )
