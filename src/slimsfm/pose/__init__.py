"""Pose of a camera from 2D-3D matches, with its focal length or the direction of gravity if asked."""

from slimsfm.pose.estimation import PoseEstimate, estimate_pose, pose_covariance
from slimsfm.pose.priors import FocalPrior, Gravity, with_focal_length
from slimsfm.pose.ransac import RansacOptions
from slimsfm.pose.refinement import refine_pose
from slimsfm.pose.types import projection_jacobian, rms_corner_errors

__all__ = [
    "FocalPrior",
    "Gravity",
    "PoseEstimate",
    "RansacOptions",
    "estimate_pose",
    "pose_covariance",
    "projection_jacobian",
    "refine_pose",
    "rms_corner_errors",
    "with_focal_length",
]
