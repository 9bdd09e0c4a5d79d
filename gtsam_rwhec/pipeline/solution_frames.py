"""A solved log as what is exported: frames, cameras, clocks and topics under the rig file's names."""

from __future__ import annotations

from gtsam_rwhec.pipeline.solved_log import Solved
from gtsam_rwhec.rig import RigFrames


def frames_of(solved: Solved) -> RigFrames:
    """What the exported files hold; sensors under their frames' names."""
    rig, refined = solved.rig, solved.refined
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
        warnings=_warnings(solved),
    )


def _warnings(solved: Solved) -> tuple[str, ...]:
    """What the exit status of solving says too."""
    said = list(solved.log.contradictions)
    certificate = solved.solution.certificate
    if not certificate.is_certified:
        said.append(f"not certified: {' '.join(certificate.reason.split())}")
    if solved.refined.free_directions:
        said.append(f"the motion does not determine {'; '.join(map(str, solved.refined.free_directions))}")
    return tuple(said)
