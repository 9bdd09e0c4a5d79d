"""Camera extrinsics as variables of a SLAM graph, in batch and in iSAM2, with nothing but GTSAM and these factors.

    python examples/slam_graph.py

A drone flies two laps through a room. Its graph has odometry and loop closures; two cameras see tags on the walls.
Where the cameras are on the drone, and where the tags are, is known to some ten degrees and decimetres at first:
``pose_robot_world_hand_eye_factor`` ties drone, tag and camera by one sighting, under a covariance of its own. Only
gtsam and numpy are needed; the picture is drawn where matplotlib is there.
"""

from __future__ import annotations

import argparse
import importlib.util
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import gtsam
import numpy as np
from gtsam.symbol_shorthand import P, X, Y
from rwhec_factors import pose_robot_world_hand_eye_factor

POSES, LAPS = 72, 2
ODOMETRY = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([0.01, 0.02], 3))  # rad, m
CLOSURE = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([0.02, 0.03], 3))
# Along the tag's axes, z towards the camera: tilt and distance are what a camera sees worst.
SIGHTING = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.02, 0.02, 0.005, 0.004, 0.004, 0.015]))
START = gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)
MOUNTED_ABOUT_THERE = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([0.3, 0.2], 3))


@dataclass(frozen=True)
class Sighting:
    pose: int
    tag: int
    camera: int
    T_camera_tag: gtsam.Pose3


@dataclass(frozen=True)
class World:
    """The truth, and what was measured of it."""

    drone: list[gtsam.Pose3]  # T_room_drone
    tags: list[gtsam.Pose3]  # T_room_tag
    cameras: list[gtsam.Pose3]  # T_drone_camera
    odometry: list[gtsam.Pose3]
    closures: list[tuple[int, int, gtsam.Pose3]]
    sightings: list[Sighting]
    cameras_guessed: list[gtsam.Pose3]


@dataclass(frozen=True)
class Incremental:
    """iSAM2's answer, and each camera's (pose, covariance) after every drone pose."""

    values: gtsam.Values
    history: list[list[tuple[gtsam.Pose3, np.ndarray]]]


def facing(forward: np.ndarray, down: np.ndarray, t_m: np.ndarray) -> gtsam.Pose3:
    """A frame whose z points forward and whose y points down, x to the right."""
    return gtsam.Pose3(gtsam.Rot3(np.column_stack([np.cross(down, forward), down, forward])), t_m)


def noisy(T: gtsam.Pose3, sigmas: np.ndarray, generator: np.random.Generator) -> gtsam.Pose3:
    return T.compose(gtsam.Pose3.Expmap(sigmas * generator.standard_normal(6)))


def simulate(seed: int) -> World:
    generator = np.random.default_rng(seed)
    down = np.array([0.0, 0.0, -1.0])
    tags = []
    for angle in np.arange(8) * np.pi / 4.0:
        inwards = -np.array([np.cos(angle), np.sin(angle), 0.0])
        tags.append(facing(inwards, down, np.array([0.0, 0.0, generator.uniform(0.8, 1.8)]) - 3.5 * inwards))
    cameras = [
        facing(np.array([1.0, 0.0, 0.0]), down, np.array([0.12, 0.00, 0.03])),
        facing(np.array([0.0, -1.0, 0.0]), down, np.array([0.02, -0.10, 0.05])),
    ]
    drone = []
    for lap in np.linspace(0.0, LAPS, POSES, endpoint=False):
        angle = 2.0 * np.pi * lap
        R = gtsam.Rot3.RzRyRx(0.3 * np.sin(3.0 * angle), 0.3 * np.cos(2.0 * angle), angle + 0.5 * np.pi)
        height = 1.3 + 0.3 * np.sin(1.5 * angle)
        drone.append(gtsam.Pose3(R, np.array([1.6 * np.cos(angle), 1.3 * np.sin(angle), height])))
    odometry = [noisy(a.between(b), ODOMETRY.sigmas(), generator) for a, b in pairwise(drone)]
    lap_length = POSES // LAPS
    closures = [
        (i, i + lap_length, noisy(drone[i].between(drone[i + lap_length]), CLOSURE.sigmas(), generator))
        for i in range(0, POSES - lap_length, 6)
    ]
    sightings = []
    for i, T_room_drone in enumerate(drone):
        for k, T_drone_camera in enumerate(cameras):
            for j, T_room_tag in enumerate(tags):
                T = T_room_drone.compose(T_drone_camera).between(T_room_tag)
                t, towards_camera = T.translation(), -T.rotation().matrix()[:, 2] @ T.translation()
                if t[2] > 0.8 * np.linalg.norm(t) and towards_camera > 0.5 * np.linalg.norm(t):
                    sightings.append(Sighting(i, j, k, noisy(T, SIGHTING.sigmas(), generator)))
    guessed = [noisy(T, np.repeat([0.15, 0.10], 3), generator) for T in cameras]
    return World(drone, tags, cameras, odometry, closures, sightings, guessed)


def steps(world: World) -> list[tuple[gtsam.NonlinearFactorGraph, gtsam.Values]]:
    """What every new drone pose adds: its factors, and first guesses of the variables that are new with it."""
    result, dead_reckoned, seen = [], world.drone[0], set()
    for i in range(len(world.drone)):
        graph, guesses = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if i == 0:
            graph.add(gtsam.PriorFactorPose3(P(0), dead_reckoned, START))
            for k, T_drone_camera in enumerate(world.cameras_guessed):
                graph.add(gtsam.PriorFactorPose3(Y(k), T_drone_camera, MOUNTED_ABOUT_THERE))
                guesses.insert(Y(k), T_drone_camera)
        else:
            dead_reckoned = dead_reckoned.compose(world.odometry[i - 1])
            graph.add(gtsam.BetweenFactorPose3(P(i - 1), P(i), world.odometry[i - 1], ODOMETRY))
        guesses.insert(P(i), dead_reckoned)
        for first, second, T in world.closures:
            if second == i:
                graph.add(gtsam.BetweenFactorPose3(P(first), P(second), T, CLOSURE))
        for seeing in world.sightings:
            if seeing.pose != i:
                continue
            # The drone's pose P is T_room_drone: the sensors' carrier in the targets' one, which is the default.
            tag, camera = X(seeing.tag), Y(seeing.camera)
            graph.add(pose_robot_world_hand_eye_factor(P(i), tag, camera, seeing.T_camera_tag, SIGHTING))
            if seeing.tag not in seen:
                seen.add(seeing.tag)
                T_room_camera = dead_reckoned.compose(world.cameras_guessed[seeing.camera])
                guesses.insert(tag, T_room_camera.compose(seeing.T_camera_tag))
        result.append((graph, guesses))
    return result


def whole(world: World) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """All of it as one graph."""
    graph, guesses = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for more, new in steps(world):
        graph.push_back(more)
        guesses.insert(new)
    return graph, guesses


def solve_in_batch(graph: gtsam.NonlinearFactorGraph, guesses: gtsam.Values) -> gtsam.Values:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    parameters.setAbsoluteErrorTol(1e-12)
    return gtsam.LevenbergMarquardtOptimizer(graph, guesses, parameters).optimize()


def solve_incrementally(world: World) -> Incremental:
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(1e-6)
    parameters.relinearizeSkip = 1
    isam = gtsam.ISAM2(parameters)
    history = []
    for graph, guesses in steps(world):
        isam.update(graph, guesses)
        isam.update()
        estimate = isam.calculateEstimate()
        history.append([(estimate.atPose3(Y(k)), isam.marginalCovariance(Y(k))) for k in range(len(world.cameras))])
    for _ in range(10):
        isam.update()
    return Incremental(isam.calculateEstimate(), history)


def difference(one: gtsam.Values, other: gtsam.Values) -> tuple[float, float]:
    """The largest (mm, degrees) between two answers."""
    apart = [gtsam.Pose3.Logmap(one.atPose3(key).between(other.atPose3(key))) for key in list(one.keys())]
    metres = max(np.linalg.norm(xi[3:]) for xi in apart)
    return 1e3 * float(metres), float(np.degrees(max(np.linalg.norm(xi[:3]) for xi in apart)))


def report(world: World, graph: gtsam.NonlinearFactorGraph, batch: gtsam.Values, incremental: Incremental) -> None:
    print(
        f"{len(world.drone)} drone poses, {len(world.closures)} loop closures, {len(world.sightings)} sightings of "
        f"{len(world.tags)} tags; chi-square {2.0 * graph.error(batch):.0f} "
        f"with {sum(graph.at(i).dim() for i in range(graph.size())) - batch.dim()} degrees of freedom"
    )
    marginals = gtsam.Marginals(graph, batch)
    for k, truth in enumerate(world.cameras):
        estimate, covariance = batch.atPose3(Y(k)), marginals.marginalCovariance(Y(k))
        sigma = np.sqrt(np.diagonal(covariance))
        # Marginals are of a right perturbation: along the camera's own axes.
        xi = gtsam.Pose3.Logmap(estimate.between(truth))
        print(f"camera {k}, T_drone_camera")
        for name, T in (("first guess", world.cameras_guessed[k]), ("true", truth), ("estimated", estimate)):
            rpy, mm = np.degrees(T.rotation().rpy()), 1e3 * T.translation()
            print(f"  {name:12s} roll, pitch, yaw {rpy.round(2)!s:26s} degrees   x, y, z {mm.round(1)} mm")
        print(f"  {'error':12s} {np.degrees(xi[:3]).round(3)} degrees, {(1e3 * xi[3:]).round(2)} mm, along its axes")
        print(f"  {'std dev':12s} {np.degrees(sigma[:3]).round(3)} degrees, {(1e3 * sigma[3:]).round(2)} mm")
        print(f"  squared Mahalanobis distance {xi @ np.linalg.solve(covariance, xi):.1f}, 95% are below 12.6")
    mm, degrees = difference(batch, incremental.values)
    print(f"Batch and iSAM2 agree to {mm:.1e} mm and {degrees:.1e} degrees over all {batch.size()} variables.")


def draw(world: World, guesses: gtsam.Values, batch: gtsam.Values, incremental: Incremental, folder: Path) -> None:
    from figures import BLUE, GREEN, GREY, ORANGE, VERMILLION, plain, save
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.6, 4.6), layout="constrained")
    room, position, rotation = figure.subplot_mosaic([["room", "position"], ["room", "rotation"]]).values()

    def path(of: gtsam.Values) -> np.ndarray:
        return np.array([of.atPose3(P(i)).translation()[:2] for i in range(len(world.drone))])

    true_path = np.array([T.translation()[:2] for T in world.drone])
    room.plot(*true_path.T, color=GREY, linewidth=5.0, alpha=0.5, label="drone: true")
    room.plot(*path(guesses).T, "--", color=ORANGE, label="drone: odometry alone")
    room.plot(*path(batch).T, color=BLUE, label="drone: the graph's answer")
    seen = sorted({seeing.tag for seeing in world.sightings})
    for of, look in (
        (world.tags, {"marker": "s", "color": GREY, "markersize": 11, "label": "tags: true"}),
        ([guesses.atPose3(X(j)) for j in seen], {"marker": "x", "color": ORANGE, "label": "tags: first guess"}),
        ([batch.atPose3(X(j)) for j in seen], {"marker": "+", "color": BLUE, "label": "tags: the graph's answer"}),
    ):
        room.plot(*np.array([T.translation()[:2] for T in of]).T, linestyle="none", **look)
    room.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", title="The room from above")
    figure.legend(*room.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)

    steps_taken = np.arange(1, len(incremental.history) + 1)
    for k, colour in enumerate((GREEN, VERMILLION)):
        truth = world.cameras[k]
        errors = np.array([gtsam.Pose3.Logmap(of[k][0].between(truth)) for of in incremental.history])
        variances = np.array([np.diagonal(of[k][1]) for of in incremental.history])
        for axes, part, unit in ((position, slice(3, 6), 1e3), (rotation, slice(0, 3), np.degrees(1.0))):
            error = unit * np.linalg.norm(errors[:, part], axis=1)
            expected = unit * np.sqrt(variances[:, part].sum(axis=1))
            axes.plot(steps_taken, error, color=colour, label=f"camera {k}: error")
            axes.plot(steps_taken, expected, ":", color=colour, linewidth=2.0, label=f"camera {k}: expected")
    position.set(ylabel="position (mm)", yscale="log", title="Extrinsics while iSAM2 goes along")
    rotation.set(ylabel="rotation (degrees)", yscale="log", xlabel="drone poses so far")
    for axes, ticks in ((position, [10, 20, 50, 100, 200, 500]), (rotation, [0.5, 1, 2, 5, 10, 20])):
        axes.set_yticks(ticks, ticks)
        axes.minorticks_off()
    position.legend(ncols=2, frameon=False, fontsize=8)
    for axes in (room, position, rotation):
        axes.grid(color="0.92")
        plain(axes)
    save(figure, folder, "slam_graph.png")


def main() -> None:
    output = Path(__file__).resolve().parent / "output"
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--save", type=Path, default=output, metavar="FOLDER", help="for the picture (%(default)s)")
    parser.add_argument("--seed", type=int, default=10, help="of the simulation (%(default)s)")
    arguments = parser.parse_args()
    np.set_printoptions(suppress=True)
    world = simulate(arguments.seed)
    graph, guesses = whole(world)
    batch = solve_in_batch(graph, guesses)
    incremental = solve_incrementally(world)
    report(world, graph, batch, incremental)
    if importlib.util.find_spec("matplotlib") is None:
        print("No picture: matplotlib is not installed.")
    else:
        draw(world, guesses, batch, incremental, arguments.save)


if __name__ == "__main__":
    main()
