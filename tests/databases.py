"""COLMAP databases of maps, as COLMAP would have left them next to the models."""

from pathlib import Path

import pycolmap

from slimsfm.mapping.map import Map


def write_features(path: Path, map_: Map) -> None:
    """The cameras, images and SIFT features of a map."""
    with pycolmap.Database.open(path) as database:
        for camera in map_.model.cameras.values():
            database.write_camera(camera, use_camera_id=True)
        for name, image in map_.images.items():
            row = pycolmap.Image(name=name, camera_id=image.camera_id, image_id=image.image_id)
            database.write_image(row, use_image_id=True)
            database.write_keypoints(image.image_id, map_.features[name].keypoints)
            descriptors = pycolmap.FeatureDescriptors(
                type=pycolmap.FeatureExtractorType.SIFT, data=map_.features[name].descriptors
            )
            database.write_descriptors(image.image_id, descriptors)
