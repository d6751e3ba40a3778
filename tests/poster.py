"""A poster on a wall and its map: photos, real features and exact geometry in a fraction of a second."""

import cv2
import numpy as np
import pycolmap
from scipy.spatial import KDTree

from slimsfm.features import load_extractor
from slimsfm.geometry import Box
from slimsfm.mapping.info import MapInfo
from slimsfm.mapping.map import Map
from slimsfm.synthetic.scene import look_at

WIDTH, HEIGHT = 320, 240
_SIDE_PX = 400
_EYES = [(-0.6, 0, -3.0), (0, 0.2, -3.2), (0.6, 0, -3.0), (0, -0.4, -3.0)]
_SAME_PX = 1.0  # largest distance between keypoints of the same point


def poster_camera() -> pycolmap.Camera:
    return pycolmap.Camera.create_from_model_name(1, "PINHOLE", 400.0, WIDTH, HEIGHT)


def poster_pose(eye) -> pycolmap.Rigid3d:
    """A camera that looks at the center of the poster in the plane z = 0."""
    return look_at(np.array(eye, float), np.zeros(3))


def poster_photo(cam_from_world: pycolmap.Rigid3d) -> np.ndarray:
    """A photo of the poster, which is two units wide and high, around the origin."""
    noise = np.random.default_rng(0).random((_SIDE_PX, _SIDE_PX, 3)).astype(np.float32)
    poster = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 3), None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U)
    world_from_poster = np.array([[2 / _SIDE_PX, 0, -1], [0, 2 / _SIDE_PX, -1], [0, 0, 1]])
    image_from_world = poster_camera().calibration_matrix() @ cam_from_world.matrix()[:, [0, 1, 3]]
    return cv2.warpPerspective(poster, image_from_world @ world_from_poster, (WIDTH, HEIGHT))


def poster_map() -> Map:
    """A map of four photos; each keypoint of the first photo that another one has too is a point."""
    extractor, camera = load_extractor("sift"), poster_camera()
    poses = {f"{number}.png": poster_pose(eye) for number, eye in enumerate(_EYES, start=1)}
    features = {name: extractor.extract(poster_photo(pose)) for name, pose in poses.items()}
    keypoints = {name: one.keypoints.astype(np.float64) for name, one in features.items()}
    points = _on_wall(keypoints["1.png"], poses["1.png"], camera)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    tracks = [pycolmap.Track() for _ in points]
    for image_id, (name, pose) in enumerate(poses.items(), start=1):
        image = pycolmap.Image(name=name, keypoints=keypoints[name], camera_id=1, image_id=image_id)
        model.add_image_with_trivial_frame(image, pose)
        gaps, rows = KDTree(keypoints[name]).query(camera.img_from_cam(pose * points))
        _, first = np.unique(rows, return_index=True)
        for point in first[gaps[first] < _SAME_PX]:
            tracks[point].add_element(image_id, int(rows[point]))
    for point, track in zip(points, tracks, strict=True):
        if track.length() >= 2:
            model.add_point3D(point, track, np.array([200, 100, 50], np.uint8))
    box = Box(np.zeros(3), np.diag([1.0, 1.0, 0.1]))
    info = MapInfo(extractor="sift", box=box, box_source="given", origin="made by the tests")
    return Map(model=model, features=features, info=info)


def _on_wall(points2D: np.ndarray, cam_from_world: pycolmap.Rigid3d, camera: pycolmap.Camera) -> np.ndarray:
    """Intersections of the rays of pixels with the wall."""
    world_from_cam = cam_from_world.inverse()
    on_plane = np.asarray(camera.cam_from_img(points2D)).reshape(-1, 2)
    rays = np.column_stack([on_plane, np.ones(len(points2D))]) @ world_from_cam.rotation.matrix().T
    eye = world_from_cam.translation
    return eye - rays * (eye[2] / rays[:, 2:])
