"""Errors and warnings. Each message says what is wrong, where, the value, and what to do."""

from __future__ import annotations

from typing import ClassVar


class RwhecError(ValueError):
    """Root of every error that bad input raises.

    Attributes
    ----------
    page : str
        The page of the guide that helps, as a path in the repository with the heading's anchor; "" where there is none.
        The command prints it after the message.
    """

    page: ClassVar[str] = ""


class PoseError(RwhecError):
    """A pose is not valid: NaN, a block that is not a rotation, a zero quaternion, or a wrong shape."""

    page = "docs/frames.md"


class CountError(RwhecError):
    """The counts of A, B, weights, stamps and covariances differ, or there are no measurements."""

    page = "docs/files.md#csv-folders"


class StampError(RwhecError):
    """Stamps are all zero, out of order or of another clock, or do not determine what is asked."""

    page = "docs/calibrate.md#what-it-does-in-order"


class NoiseError(RwhecError):
    """A sigma or kappa is not positive and finite, or a covariance is not positive definite."""

    page = "docs/refinement.md"


class FrameError(RwhecError):
    """A frame's name is unknown, empty, or used for both a target and a sensor."""

    page = "docs/frames.md"


class PriorError(RwhecError):
    """Fixed frames or priors contradict one another, or do not fit the problem."""


class UnderdeterminedError(RwhecError):
    """There are fewer equations than unknowns: no method can solve the problem."""

    page = "docs/certificate.md#what-the-motion-leaves-free"


class ScaleError(RwhecError):
    """A scale is not positive, in the input or at the optimum, or the motion does not tell it."""

    page = "docs/calibrate.md#what-it-does-in-order"


class OptionError(RwhecError):
    """An option, a method or a starting point cannot be used."""


class MissingPackageError(ModuleNotFoundError, RwhecError):
    """A package that an extra of this package installs is missing; the message has the command that installs it."""


class MeasurementsNotKeptError(RwhecError):
    """Raw measurements are needed, but the problem was made with ``keep_measurements=False``."""


class OutlierError(RwhecError):
    """Too few measurements agree with one another for an answer."""

    page = "docs/calibrate.md#the-verdict"


class FileFormatError(RwhecError):
    """A file cannot be read in its format; the message has the file and the line or field."""

    page = "docs/files.md"


class RigError(FileFormatError):
    """A rig file cannot be used (the message has each fault with its line), or cannot be made from a log."""

    page = "docs/rig_file.md"


class ManifestError(FileFormatError):
    """The manifest of a fleet has faults; the message names every fault with its line."""

    page = "docs/fleets.md#the-manifest"


class LogError(FileFormatError):
    """A log cannot be read or written, or lacks what is asked of it."""

    page = "docs/from_a_log.md#what-a-log-may-be"


class MessageError(LogError):
    """A message of a log does not fit its schema, or has values that are not valid."""


class BudgetError(LogError):
    """A log asks for more memory or work than a file of its size may: it is damaged, or made to exhaust its reader."""

    page = "SECURITY.md#what-is-promised"


class TransformError(RwhecError):
    """No chain of transforms joins two frames, or the chain is a loop; the message has the chain."""

    page = "docs/frames.md"


class CameraError(RwhecError):
    """Intrinsics are not valid or of an unsupported model, or no lens can have seen a point."""

    page = "docs/corners.md#what-you-state"


class ImageError(RwhecError):
    """An image cannot be decoded or does not fit its camera; the message has topic and stamp."""

    page = "docs/from_a_log.md#folders-of-images"


class CloudError(RwhecError):
    """A point cloud cannot be read or used: nothing is seen in it, or it belongs to another view."""

    page = "docs/clouds.md"


class TargetError(RwhecError):
    """A target cannot be printed: an unknown family, an id that the family lacks, or a size that is not valid."""

    page = "docs/from_a_log.md#the-targets-of-a-rig-file"

    def __init__(self, fault: str, target: str = "") -> None:
        super().__init__(f"target {target}: {fault}" if target else fault)
        self.fault = fault


class ResultVersionError(FileFormatError):
    """A result file has an unknown version of the format."""

    page = "docs/files.md#what-stays-stable"


class FetchError(RwhecError):
    """A download failed, or its content is not the expected one."""


class FleetError(RwhecError):
    """A run over many robots cannot go on: its tasks contradict one another, or its engine is gone."""


class StoreError(RwhecError):
    """A store refuses, or has not what was asked of it: a file that is not there, credentials that are not accepted."""


class StoreInterruptedError(StoreError, OSError):
    """A store broke off or does not answer, more than once; it may work later. The message says how far it came."""


class RwhecWarning(UserWarning):
    """Root of every warning."""


class LogWarning(RwhecWarning):
    """Parts of a log could not be read; the message says which, how many and why."""


class EvidenceWarning(RwhecWarning):
    """The evidence beside a result cannot be shown: it is damaged, or of another result. The message says which."""


class UnfinishedRigWarning(RwhecWarning):
    """Lines of a rig file are still marked TODO: their values are guesses. The message names the lines."""


class UnitsWarning(RwhecWarning):
    """Numbers look as if they had another unit."""


class NotUniqueWarning(RwhecWarning):
    """The measurements do not determine the answer in some direction."""


class NotCertifiedWarning(RwhecWarning):
    """No proof of global optimality was found."""


class WeightsWarning(RwhecWarning):
    """Residuals are far larger than the stated weights predict."""


class OutliersWarning(RwhecWarning):
    """Fewer than half of a frame's measurements, or of all, agree with the rest; or views of a thing are left out."""


class NotConvergedWarning(RwhecWarning):
    """An iteration stopped at its limit."""


class CameraWarning(RwhecWarning):
    """A lens model has no ray for a part of the image."""


class RotationsProjectedWarning(RwhecWarning):
    """Matrices that were not quite rotations were projected to the nearest rotation."""
