"""A refinement from corners in numbers, as results and reports have them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gtsam_rwhec.refinement.options import CarrierNoise
from gtsam_rwhec.refinement.reprojection_found import Regions, Reprojection, SensorReprojection, TriedModel
from gtsam_rwhec.reprojection.as_refined import boards_of
from gtsam_rwhec.reprojection.consequences import consequences_of
from gtsam_rwhec.reprojection.held_out import HeldOut
from gtsam_rwhec.reprojection.observations import Observations
from gtsam_rwhec.reprojection.options import CornerOptions
from gtsam_rwhec.reprojection.refined import CornersRefined


def numbers_of(
    observations: Observations,
    corners: CornersRefined,
    options: CornerOptions,
    held_out: Mapping[str, HeldOut] | None = None,
    tried: tuple[TriedModel, ...] = (),
) -> Reprojection:
    """Errors of all corners and by sensor, noise, boards, and what errors of what is kept would do.

    Parameters
    ----------
    observations, options
        What was refined from, and how.
    corners : CornersRefined
    held_out : dict of str to HeldOut, optional
        Errors in images that were left out, by sensor.
    tried : tuple of TriedModel
        Models that were compared.
    """
    there = held_out or {}
    sensors = {name: _of_sensor(name, observations, corners, there.get(name)) for name in corners.Y}
    squares = sum(one.corners * one.rms_px**2 for one in sensors.values())
    given = isinstance(options.carrier_noise, CarrierNoise)
    return Reprojection(
        rms_px=float(np.sqrt(squares / max(sum(one.corners for one in sensors.values()), 1))),
        corner_px=corners.noise.corner_px,
        carrier_poses="exact" if corners.noise.carrier is None else "given" if given else "estimated",
        carrier_rotation_rad=corners.noise.carrier_rad,
        carrier_translation_m=corners.noise.carrier_m,
        sensors=sensors,
        boards=boards_of(corners),
        tried=tried,
        consequences=consequences_of(corners),
    )


def _of_sensor(
    name: str, observations: Observations, corners: CornersRefined, held_out: HeldOut | None
) -> SensorReprojection:
    views = {pair: view for pair, view in observations.views.items() if pair[1] == name}
    left_out = sum(int(corners.left_out[pair].sum()) for pair in views)
    return SensorReprojection(
        images=sum(len(view.A) for view in views.values()),
        corners=sum(int(view.known.sum()) for view in views.values()) - left_out,
        left_out=left_out,
        rms_px=corners.intrinsics[name].rms_px,
        held_out_px=None if held_out is None else held_out.rms_px,
        held_out_mm=None if held_out is None else held_out.rms_mm,
        regions_px=() if held_out is None else _regions(held_out),
        expected_px=None if held_out is None else held_out.expected_px,
    )


def _regions(held_out: HeldOut) -> Regions:
    return tuple(
        tuple(None if np.isnan(value) else float(value) for value in row) for row in held_out.regions_px.tolist()
    )
