"""Errors and warnings. Each message says what was wrong, where, the value, and what to do."""

from __future__ import annotations


class RwhecError(ValueError):
    """Root of every error that bad input raises."""


class PoseError(RwhecError):
    """A pose that is not one: NaN, a rotation block that is no rotation, a zero quaternion, a wrong shape."""


class CountError(RwhecError):
    """Different numbers of A and B, or of weights, stamps and covariances for them; or none at all."""


class StampError(RwhecError):
    """Stamps that are all zero, out of order, of another clock, or do not tell what is asked of them."""


class NoiseError(RwhecError):
    """A sigma or kappa that is not a positive, finite number; a covariance that is not positive definite."""


class FrameError(RwhecError):
    """A frame name that is unknown, empty, or used for both a target and a sensor."""


class PriorError(RwhecError):
    """Fixed frames or priors that contradict one another, or that the problem cannot hold."""


class UnderdeterminedError(RwhecError):
    """Fewer equations than unknowns: no method can answer."""


class ScaleError(RwhecError):
    """A scale that is not positive, in the input or at the optimum."""


class OptionError(RwhecError):
    """An option, a method or a starting point that cannot be used."""


class MeasurementsNotKeptError(RwhecError):
    """Raw measurements are asked for and the problem was told not to keep them."""


class OutlierError(RwhecError):
    """Too few measurements agree with one another for any answer."""


class FileFormatError(RwhecError):
    """A file that cannot be read as what it should be; the message has the file and the line or field."""


class RigError(FileFormatError):
    """A rig file that cannot be used, each fault with its line; or a log of which none can be made."""


class LogError(FileFormatError):
    """A log that cannot be read, or lacks what is asked of it; or one that could not be written."""


class MessageError(LogError):
    """A message of a log that cannot be read as its schema says, or whose content makes no sense."""


class TransformError(RwhecError):
    """Frames that no chain of transforms joins, or that go round in a loop; the message has the chain."""


class CameraError(RwhecError):
    """Intrinsics that are those of no camera, or of a model that is not supported; a point no lens can have seen."""


class ImageError(RwhecError):
    """An image that cannot be decoded, or is not what its camera takes; the message has topic and stamp."""


class TargetError(RwhecError):
    """A target that cannot be printed: an unknown family, an id that it lacks, a size that is none."""

    def __init__(self, fault: str, target: str = "") -> None:
        super().__init__(f"target {target}: {fault}" if target else fault)
        self.fault = fault


class ResultVersionError(FileFormatError):
    """A result file that another version of the format wrote."""


class FetchError(RwhecError):
    """A download that failed or whose content is not what was expected."""


class RwhecWarning(UserWarning):
    """Root of every warning."""


class LogWarning(RwhecWarning):
    """Parts of a log that could not be read: what, how much, why."""


class UnitsWarning(RwhecWarning):
    """Numbers that look as if they had another unit."""


class NotUniqueWarning(RwhecWarning):
    """The measurements leave the answer free in some direction."""


class NotCertifiedWarning(RwhecWarning):
    """No proof of global optimality was found."""


class WeightsWarning(RwhecWarning):
    """Residuals far beyond what the stated weights predict."""


class OutliersWarning(RwhecWarning):
    """Less than half of a frame's measurements, or of all, agree with the rest."""


class NotConvergedWarning(RwhecWarning):
    """An iteration that stopped at its limit."""


class RotationsProjectedWarning(RwhecWarning):
    """Rotation blocks were slightly off and were projected to the nearest rotation."""
