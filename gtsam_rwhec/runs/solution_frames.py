"""The calibrated frames of a solved log, for the exported files: poses, cameras, time offsets and topics."""

from __future__ import annotations

from collections.abc import Iterable

from gtsam_rwhec.calibration.verdict import Verdict
from gtsam_rwhec.files.terminal_text import natural_key
from gtsam_rwhec.results.result_judgement import shortage
from gtsam_rwhec.rig import CameraLink, Rig, RigFrames
from gtsam_rwhec.rig.rig_frames import known_cameras
from gtsam_rwhec.rig.sections import link_of_optical
from gtsam_rwhec.runs.solving_stage import Solved

#: Of intrinsics that were estimated before detection, and that no refinement from corners made better.
BOARDS_ALONE = "estimated from views of boards alone, before the poses; standard deviations are not known"


def frames_of(solved: Solved) -> RigFrames:
    """The calibrated frames; a sensor has the name of its frame, and estimated intrinsics if there are any."""
    rig, refined = solved.rig, solved.refined
    missing = [name for name in (*rig.calibrated, *rig.targets) if name not in refined.X and name not in refined.Y]
    frame = {name: rig.frame_of(name) for name in refined.Y}
    cameras, of_corners = known_cameras(solved.cameras, refined.intrinsics)
    origins = origins_before_corners(rig, cameras) | of_corners
    return RigFrames(
        sensor_carrier=rig.carriers.sensors,
        target_carrier=rig.carriers.targets,
        sensors={frame[name]: pose.matrix() for name, pose in refined.Y.items()},
        targets={name: pose.matrix() for name, pose in refined.X.items()},
        cameras={frame[name]: camera for name, camera in cameras.items() if name in frame},
        camera_origins={frame[name]: words for name, words in origins.items() if name in frame},
        time_offsets_s={frame[o.sensor]: o.offset_s for o in solved.log.time_offsets if o.sensor in frame},
        topics={frame[n]: s.images for n, s in rig.sensors.items() if s.images is not None and n in frame},
        links={
            frame[name]: CameraLink(sensor.link.frame, link_of_optical(sensor.link.T_link_optical))
            for name, sensor in rig.sensors.items()
            if sensor.link is not None and name in frame
        },
        warnings=warnings_of(solved),
        left_out={name: shortage(solved.log, name) for name in missing},
    )


def origins_before_corners(rig: Rig, sensors: Iterable[str]) -> dict[str, str]:
    """Where the intrinsics of sensors are from that state none, as detection used them; the others' are as stated."""
    return {name: BOARDS_ALONE for name in sensors if rig.sensors[name].stated == "unknown"}


def warnings_of(solved: Solved) -> tuple[str, ...]:
    """Why the frames, or some of them, are not to be used; empty where they are."""
    if solved.judgement.verdict is Verdict.USE:
        return ()
    free = sorted({name for each in solved.refined.free_directions for name in each.frames}, key=natural_key)
    return (str(solved.judgement), *([f"Not determined: {', '.join(free)}"] if free else []))
