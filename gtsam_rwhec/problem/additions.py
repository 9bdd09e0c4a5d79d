"""What users add to a problem: poses, points, planes, corners and motions, checked, summed, and kept."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Literal

from numpy.typing import ArrayLike

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import (
    CountError,
    FrameError,
    MeasurementsNotKeptError,
    NoiseError,
    RotationsProjectedWarning,
    ScaleError,
)
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.poses import ROTATION_TOLERANCE, Array, PosesLike, QuaternionOrder, as_transforms
from gtsam_rwhec.problem.accumulation import Accumulator
from gtsam_rwhec.problem.corners import (
    EachImage,
    candidates_of,
    check_camera,
    check_corner_px,
    check_in_image,
    seen_corners,
)
from gtsam_rwhec.problem.directions import planes_as_given, points_as_given
from gtsam_rwhec.problem.knowledge import Knowledge, ScaleMode, check_name
from gtsam_rwhec.problem.many_measurements import GivenMany, KeptMeasurements, Section, Sorted
from gtsam_rwhec.problem.measurements import GivenMeasurements, Kind, LongTranslations, Pair, warn_of_millimetres

#: The roles of a pair's two names.
SIDES: tuple[Literal["target"], Literal["sensor"]] = ("target", "sensor")


def warn_of_projected(where: str, projected: int, stacklevel: int) -> None:
    """Warn of rotations that were not exact."""
    warnings.warn(
        f"{where}: {projected} rotations were not exact: R'R differs from I, by less than "
        f"{ROTATION_TOLERANCE:g}; they were projected to the nearest rotation",
        RotationsProjectedWarning,
        stacklevel=stacklevel + 1,
    )


def seen_pair(target: str, sensor: str) -> Pair:
    """A target and the sensor that saw it; a FrameError if a name is not valid, or both are the same."""
    check_name(target, "the target's name")
    check_name(sensor, "the sensor's name")
    if target == sensor:
        raise FrameError(f"{target!r} is given as target and as sensor; names are unique across both")
    return Pair(target, sensor)


def _kind_of(covariances: ArrayLike | None, directional: bool) -> Kind:
    """The kind of a batch of poses."""
    if directional and covariances is None:
        raise NoiseError("directional=True weighs by direction; give covariances, which have the directions")
    return Kind.DIRECTIONAL if directional else Kind.POSE


class Additions(Knowledge):
    """The part of a problem to which measurements are added."""

    def __init__(
        self,
        scale: ScaleMode = "known",
        *,
        keep_measurements: bool = True,
        sensor_carrier: str | None = None,
        target_carrier: str | None = None,
    ) -> None:
        super().__init__(scale)
        for name, what in ((sensor_carrier, "sensor_carrier"), (target_carrier, "target_carrier")):
            if name is not None:
                check_name(name, what)
        if sensor_carrier is not None and sensor_carrier == target_carrier:
            raise FrameError(f"both carriers are named {brief(sensor_carrier)}; give each its own name")
        self.sensor_carrier = sensor_carrier
        self.target_carrier = target_carrier
        self.keep_measurements = keep_measurements
        self.is_relative = False  # whether the noise of some measurements is not stated
        self._kind: dict[str, Literal["target", "sensor"]] = {}
        self._kept: dict[Pair, KeptMeasurements] = {}
        #: Poses (4, 4) of targets to which measurements that weigh by direction were slid (`aligned_at`), and the
        #: directions (6, k) of their own axes in which all of them slide.
        self.held: dict[str, tuple[Array, Array]] = {}
        self._accumulator = Accumulator()
        self._long: frozenset[str] = frozenset()  # which of "A" and "B" had the millimetre warning

    def add(
        self,
        target: str,
        sensor: str,
        A: PosesLike,
        B: PosesLike,
        sigma: ArrayLike | None = None,
        kappa: ArrayLike | None = None,
        *,
        order: QuaternionOrder | None = None,
        stamps_ns: ArrayLike | None = None,
        covariances: ArrayLike | None = None,
        source: str | None = None,
        directional: bool = False,
    ) -> None:
        """Add measurements of a target by a sensor; any number of batches, in any order.

        Parameters
        ----------
        target, sensor : str
            Names, unique across targets and sensors.
        A, B : (N, 4, 4) arrays, lists of gtsam.Pose3, or (N, 7) rows of quaternion and translation
            A = T_sensorcarrier_targetcarrier, B = T_sensor_target; metres.
        sigma : float or (N,), optional
            Standard deviation of B's translation along each axis, in metres. Left out: 1, and costs are relative.
        kappa : float or (N,), optional
            Concentration of B's rotation: 1 / (2 s^2) for a standard deviation of s rad about each axis.
        order : "wxyz" or "xyzw"
            Order of the quaternions, for rows of 7.
        stamps_ns : (N,) integers, optional
            Nanoseconds, which do not go back within the batch; kept for refinement.
        covariances : (N, 6, 6), optional
            Covariances of B in place of sigma and kappa: rotation first, right perturbation (GTSAM's order).
            Refinement uses the whole matrix, the certified solution the mean variance of each block.
        source : str, optional
            Where the measurements come from (a file, a topic); errors name it.
        directional : bool
            The certified solution too weighs each measurement by its whole covariance: a direction in which B slides
            (a very large variance) has next to no weight. Needs ``covariances`` and kept measurements.

        Raises
        ------
        PoseError, CountError, NoiseError, FrameError, StampError
            A name, pose, weight, stamp or covariance is not valid; nothing of the batch is added then.
        """
        kind = _kind_of(covariances, directional)
        given = GivenMeasurements(A, B, sigma, kappa, order, stamps_ns, covariances, source, kind=kind)
        self.add_batch(seen_pair(target, sensor), given)

    def add_points(
        self,
        target: str,
        sensor: str,
        A: PosesLike,
        points: ArrayLike,
        sigma: ArrayLike | None = None,
        *,
        covariances: ArrayLike | None = None,
        order: QuaternionOrder | None = None,
        stamps_ns: ArrayLike | None = None,
        source: str | None = None,
    ) -> None:
        """Add measurements of one fixed point of a target: the centre of a sphere, a reflector, a tool's tip.

        The point is the target's origin. Where nothing else tells the target's rotation it means nothing: its axes are
        then those of its carrier, by convention.

        Parameters
        ----------
        target, sensor : str
            Names, unique across targets and sensors.
        A : (N, 4, 4) array, list of gtsam.Pose3, or (N, 7) rows of quaternion and translation
            T_sensorcarrier_targetcarrier at each measurement; metres.
        points : (N, 3)
            The point in the sensor's frame, metres.
        sigma : float or (N,), optional
            Standard deviation of a point along each axis, metres.
        covariances : (3, 3) or (N, 3, 3), optional
            Covariances of the points in the sensor's axes, m^2, in place of sigma.
        order, stamps_ns, source
            As in ``add``.

        Raises
        ------
        PoseError, CountError, NoiseError, FrameError, StampError, MeasurementsNotKeptError
            As in ``add``; or the problem keeps moments only.
        """
        pair = seen_pair(target, sensor)
        where = f"{pair} ({source})" if source else pair.label
        self.add_batch(pair, points_as_given(A, points, sigma, covariances, order, stamps_ns, source, where))

    def add_planes(
        self,
        target: str,
        sensor: str,
        A: PosesLike,
        normals: ArrayLike,
        points_on_plane: ArrayLike,
        normal_rad: ArrayLike,
        offset_m: ArrayLike,
        *,
        order: QuaternionOrder | None = None,
        stamps_ns: ArrayLike | None = None,
        source: str | None = None,
    ) -> None:
        """Add measurements of one fixed plane of a target, as a LiDAR sees a board or a depth camera the floor.

        The plane is the target's plane z = 0, and z is its normal. Where nothing else tells the rest of the target's
        pose it means nothing: by convention the origin is then the plane's point nearest to the carrier's origin, and
        x is as near as may be to the carrier's x axis (to y where the normal is near x).

        Parameters
        ----------
        target, sensor : str
            Names, unique across targets and sensors.
        A : (N, 4, 4) array, list of gtsam.Pose3, or (N, 7) rows of quaternion and translation
            T_sensorcarrier_targetcarrier at each measurement; metres.
        normals : (N, 3)
            Unit normals in the sensor's frame, all towards the same side of the plane.
        points_on_plane : (N, 3)
            A point of each plane in the sensor's frame, metres: the middle of the points that the plane was fitted to.
        normal_rad : float or (N,)
            Standard deviation of the normal about each axis in the plane, rad.
        offset_m : float or (N,)
            Standard deviation of the plane along its normal at the given point, metres.
        order, stamps_ns, source
            As in ``add``.

        Raises
        ------
        PoseError, CountError, NoiseError, FrameError, StampError, MeasurementsNotKeptError
            As in ``add``; or a normal is no unit vector, or the problem keeps moments only.
        """
        pair = seen_pair(target, sensor)
        where = f"{pair} ({source})" if source else pair.label
        noise = normal_rad, offset_m
        given = planes_as_given(A, normals, points_on_plane, *noise, order, stamps_ns, source, where)
        self.add_batch(pair, given)

    def add_many(
        self,
        pairs: Sequence[tuple[str, str]],
        index: ArrayLike,
        A: PosesLike,
        B: PosesLike,
        sigma: ArrayLike | None = None,
        kappa: ArrayLike | None = None,
        *,
        order: QuaternionOrder | None = None,
        stamps_ns: ArrayLike | None = None,
        covariances: ArrayLike | None = None,
        source: str | None = None,
    ) -> None:
        """Add measurements of many pairs at once: much faster than ``add`` for thousands of pairs with few each.

        Parameters
        ----------
        pairs : sequence of (target, sensor)
            Names of the pairs, each once.
        index : (N,) integers
            The place in ``pairs`` of each measurement's pair, in any order.
        A, B, sigma, kappa, order, covariances, source
            As in ``add``, for all N measurements.
        stamps_ns : (N,) integers, optional
            Nanoseconds, which do not go back among the measurements of a pair.

        Raises
        ------
        PoseError, CountError, NoiseError, FrameError, StampError
            As in ``add``, with the measurement's place in the arrays; nothing is added then.
        """
        given = GivenMany(pairs, index, GivenMeasurements(A, B, sigma, kappa, order, stamps_ns, covariances, source))
        given.measurements.check_source()
        many = given.checked()
        for pair in many.pairs:
            self._check_names(pair, pair.label)
        self._add(many, given.where, given.measurements.has_noise, stacklevel=3)

    def add_corners(
        self,
        target: str,
        sensor: str,
        A: PosesLike,
        image_points: EachImage,
        board_points: EachImage | None = None,
        camera: Camera | None = None,
        *,
        corner_ids: Sequence[ArrayLike] | None = None,
        corner_px: float | None = None,
        order: QuaternionOrder | None = None,
        stamps_ns: ArrayLike | None = None,
        source: str | None = None,
    ) -> None:
        """Add images of a target: its corners in pixels, which a refinement may use directly.

        Each image is a measurement too: B is the target's pose by its corners alone, with its covariance. Of the two
        poses that a flat board nearly has in an image, all images of a call choose those that agree with A: give all
        images of a pair at once. Corners are kept with the raw measurements, where these are selected or joined.

        Parameters
        ----------
        target, sensor : str
            Names, unique across targets and sensors.
        A : (N, 4, 4) array, list of gtsam.Pose3, or (N, 7) rows of quaternion and translation
            T_sensorcarrier_targetcarrier at each image; metres.
        image_points : (N, n, 2) array, or a list of N arrays (n_i, 2)
            Pixels, x to the right and y down, the middle of the first pixel at 0; nan where a corner was not seen.
        board_points : (n, 3) array, or a list of N arrays (n_i, 3)
            The target's corners in its own frame, metres; or those of each image (OpenCV's object points). Left out:
            those that the target has already.
        camera : Camera, optional
            The sensor's intrinsics. Left out: those that it has already.
        corner_ids : list of N arrays (n_i,), optional
            Which of the board's corners each image has.
        corner_px : float, optional
            Standard deviation of a corner along each axis, pixels; 0.1 if left out. One for all corners of a problem.
        order, stamps_ns, source
            As in ``add``.

        Raises
        ------
        CameraError
            There is no camera, or the sensor has a different one, or images of another size; a corner is outside the
            image, or the lens model has no ray for it; an image has no pose.
        CountError
            An image has fewer than four corners, or the numbers of poses, images and corners differ.
        MeasurementsNotKeptError
            The problem keeps moments only.
        TargetError
            There is no board, the target has a different one, or the corners do not belong to it.
        PoseError, NoiseError, FrameError, StampError
            As in ``add``; nothing of the images is added then.
        """
        pair = seen_pair(target, sensor)
        where = f"{pair} ({source})" if source else pair.label
        self._check_names(pair, where)
        if not self.keep_measurements:
            raise MeasurementsNotKeptError(
                f"{where}: corners are kept with the raw measurements, and this problem keeps none "
                "(keep_measurements=False); make it with keep_measurements=True, or add poses"
            )
        camera = check_camera(camera, self.cameras.get(sensor), sensor, where)
        corner_px = check_corner_px(corner_px, self.corner_px, where)
        seen = seen_corners(image_points, board_points, corner_ids, self.boards.get(target), where)
        T = as_transforms(A, order, f"A of {where}")
        if len(T) != len(seen.pixels):
            raise CountError(f"{where}: {len(T)} poses in A and {len(seen.pixels)} images; give one A for each image")
        check_in_image(seen.pixels, camera, where)
        both = candidates_of(camera, seen.board, seen.pixels, corner_px, where)
        B, covariances = both.chosen(both.by_carriers(T))
        self.add_batch(pair, GivenMeasurements(A, B, None, None, order, stamps_ns, covariances, source, seen.pixels))
        self.cameras[sensor], self.boards[target], self.corner_px = camera, seen.board, corner_px

    def add_motion(
        self,
        sensor: str,
        A: PosesLike,
        B: PosesLike,
        sigma: ArrayLike | None = None,
        kappa: ArrayLike | None = None,
        *,
        order: QuaternionOrder | None = None,
        stamps_ns: ArrayLike | None = None,
        covariances: ArrayLike | None = None,
        source: str | None = None,
        directional: bool = False,
    ) -> None:
        """Add motions of a sensor and its carrier: A Y = Y B (AX = XB). Arguments and errors as in ``add``.

        A is the carrier's motion and B the motion that the sensor measured, both T_before_after.
        """
        check_name(sensor, "the sensor's name")
        kind = _kind_of(covariances, directional)
        given = GivenMeasurements(A, B, sigma, kappa, order, stamps_ns, covariances, source, kind=kind)
        self.add_batch(Pair(sensor, sensor), given)

    def add_batch(self, pair: Pair, given: GivenMeasurements, long: list[LongTranslations] | None = None) -> None:
        """Add a batch of measurements or motions; ``add`` and ``add_motion`` say which, and have the errors.

        If ``long`` is given, translations that look like millimetres are appended to it, and the caller warns once of
        all.
        """
        given.check_source()
        where = f"{pair} ({given.source})" if given.source else pair.label
        self._check_names(pair, where)
        if given.kind is not Kind.POSE:
            self._check_can_weigh(where)
        many = Sorted.of(pair, given.checked(where), f" ({given.source})" if given.source else "")
        self._add(many, where, given.has_noise, stacklevel=4, long=long)

    def _add(
        self, many: Sorted, where: str, has_noise: bool, *, stacklevel: int, long: list[LongTranslations] | None = None
    ) -> None:
        # With a known scale nothing reads the sums of B's rotations; but one pair's take little memory.
        with_R_B = self.scale != "known" or len(many.pairs) == 1
        accumulator, projected = self._accumulator.added(many, with_R_B=with_R_B)
        if projected:
            warn_of_projected(where, projected, stacklevel)
            many = many.projected()
        elif self.keep_measurements and many.given is None:
            many = many.copied()
        translations = many.long_translations(accumulator.gauge, where)
        if long is not None:
            long.append(translations)
        elif not translations.sizes.keys() <= self._long:
            warn_of_millimetres([translations], stacklevel)
        # The problem changes only after all checks and warnings: a warning may be raised as an error.
        self._accumulator = accumulator
        self._long |= translations.sizes.keys()
        self.is_relative = self.is_relative or not has_noise
        has_covariances = many.covariances is not None
        nothing = KeptMeasurements((), has_covariances)  # one for all pairs
        for number, pair in enumerate(many.pairs):
            self._kind |= {pair.target: "target", pair.sensor: "sensor"}  # a motion's one name is its sensor's
            kept = KeptMeasurements((Section(many, number),), has_covariances) if self.keep_measurements else nothing
            self._kept[pair] = self._kept[pair] + kept if pair in self._kept else kept

    def _check_can_weigh(self, where: str) -> None:
        """Refuse measurements that weigh by direction where the certified form cannot hold them."""
        if not self.keep_measurements:
            raise MeasurementsNotKeptError(
                f"{where}: measurements that weigh by direction are kept one by one, and this problem keeps none "
                "(keep_measurements=False); make it with keep_measurements=True"
            )
        if self.scale == "per_target":
            raise ScaleError(
                f"{where}: with scale='per_target' the certified form cannot weigh by direction; take scale='known', "
                "or 'shared' for one unknown scale"
            )

    def _check_names(self, pair: Pair, where: str) -> None:
        for name, kind in zip(pair, SIDES, strict=True):
            if not pair.is_motion and self._kind.get(name, kind) != kind:
                raise FrameError(
                    f"{where}: {name!r} is a {self._kind[name]} already and cannot be a {kind} too; "
                    "names are unique across targets and sensors"
                )
        if pair.is_motion and self._kind.get(pair.sensor) == "target":
            raise FrameError(f"{where}: {pair.sensor!r} is a target; only sensors have motions of their own")
