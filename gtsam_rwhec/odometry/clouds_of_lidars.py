"""What the clouds of LiDARs tell beside their motions: maps registered with each other, as known poses."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.clouds.cloud import Cloud
from gtsam_rwhec.clouds.lidar_pair import LidarsTogether
from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.geometry.odometry_track import OdometryTrack
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.odometry.prior_knowledge import KnownPose
from gtsam_rwhec.odometry.window_likelihood import OFFSET
from gtsam_rwhec.odometry.window_solution import Answer, Task

#: LiDARs whose clouds are registered are looked for within about this distance of each other, m.
NEAR_M = 3.0


def near_poses(answer: Answer, task: Task) -> Array:
    """Poses (m, 4, 4) in the frame of the first sensor, as near to it as the motions allow: vehicles are small.

    A drive near a plane tells a height to 60 m, and puts the sensor anywhere there.
    """
    T, C = answer.fit.state.T.copy(), answer.freedom.covariance() + answer.errors.widening
    for k in range(1, len(T)):
        at = task.layout.at[k, 3:6]
        turned = T[k, :3, :3] @ C[np.ix_(at, at)] @ T[k, :3, :3].T
        T[k, :3, 3] -= turned @ np.linalg.solve(turned + NEAR_M**2 * np.eye(3), T[k, :3, 3])
    return T


def registered_maps(
    answer: Answer,
    task: Task,
    T: Array,
    tracks: Sequence[OdometryTrack],
    offsets_s: Array,
    maps: Mapping[str, Sequence[Cloud]],
    tell: Progress,
) -> list[LidarsTogether]:
    """What the maps of every two LiDARs tell of their pose, from poses (m, 4, 4) and time offsets (m,)."""
    if not any(maps.values()):
        return []
    from gtsam_rwhec.clouds import LidarPath, register_lidars  # needs an extra that motions do without

    tell("registering the clouds of LiDARs with each other")
    C = np.pad(answer.freedom.covariance(), ((0, 1), (0, 1)))
    paths = []
    for k, track in enumerate(tracks):
        after_ns, clock = round(1e9 * float(offsets_s[k])), task.layout.at[k, OFFSET]
        clouds = [replace(each, stamp_ns=(each.stamp_ns or 0) + after_ns) for each in maps.get(track.sensor, ())]
        if clouds:
            path = Trajectory(np.asarray(track.stamps_ns) + after_ns, np.asarray(track.T_start_sensor))
            paths.append((LidarPath(track.sensor, clouds, path, float(np.sqrt(C[clock, clock]))), T[k]))
    return [
        register_lidars(one, other, se3.inverse(T_one[None])[0] @ T_other)
        for (one, T_one), (other, T_other) in combinations(paths, 2)
    ]


def poses_of(together: Sequence[LidarsTogether]) -> list[KnownPose]:
    """Those that are used. The errors of a LiDAR's maps are in all of its pairs, so that each pair counts as less."""
    used = [each for each in together if not each.why_not]
    pairs_of = Counter(name for each in used for name in (each.first, each.second))
    return [pose_of(each, 4.0 / (pairs_of[each.first] + pairs_of[each.second] + 2)) for each in used]


def pose_of(together: LidarsTogether, share: float = 1.0) -> KnownPose:
    """What the maps of two LiDARs tell, with a share of its information."""
    return KnownPose(together.first, together.second, together.T_first_second, share * together.information)
