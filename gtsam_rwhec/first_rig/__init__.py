"""A first rig file, made by looking at a log."""

from gtsam_rwhec.first_rig.rig_from_look import first_rig

__all__ = ["first_rig"]
