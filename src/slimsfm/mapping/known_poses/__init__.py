"""Poses of photos that are known before a map is built, one format a module."""

from slimsfm.mapping.known_poses.reading import FORMATS, pose_photos, read_given

__all__ = ["FORMATS", "pose_photos", "read_given"]
