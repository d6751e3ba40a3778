import numpy as np
import pycolmap
import pytest

from disturbances import CHANGES, DISTURBANCES, Place, View, film_focal_mm, given_camera, object_window
from slimsfm.geometry import Box, project
from slimsfm.pose.priors import with_focal_length

BOX = Box(np.zeros(3), np.diag([0.4, 0.3, 0.2]))
CAMERAS = [
    pycolmap.Camera(model="SIMPLE_RADIAL", width=320, height=240, params=[300.0, 163.0, 118.0, -0.1]),
    pycolmap.Camera(model="PINHOLE", width=240, height=320, params=[300.0, 310.0, 121.0, 158.0]),
]
POSE = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.1, -0.1, 0.05])), np.array([0.02, 0.01, 2.0]))
MOVES = ("clean", "zoom1.3", "zoom2", "frame", "crop70", "corner", "stabilizer", "squeezed", "mirrored")


def place():
    return Place(box=BOX, rng=np.random.default_rng(3))


def gray(camera):
    return np.full((camera.height, camera.width, 3), 100, np.uint8)


def spot(camera, pixel):
    """A soft red spot at a pixel of a black image."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    image = np.zeros((camera.height, camera.width, 3), np.uint8)
    image[..., 0] = np.round(200 * np.exp(-((x - pixel[0]) ** 2 + (y - pixel[1]) ** 2) / 8))
    return image


def center(image):
    """Centroid of what is red, neither black nor the white of a frame."""
    value = image[..., 0].astype(float) - image[..., 1]
    y, x = np.indices(value.shape) + 0.5
    return np.array([(value * x).sum(), (value * y).sum()]) / value.sum()


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.model.name)
@pytest.mark.parametrize("name", MOVES)
def test_the_true_camera_sees_points_where_the_changed_photo_shows_them(name, camera):
    seen = 0
    for point in np.random.default_rng(0).uniform(-0.3, 0.3, (20, 3)):
        pixel = project(point[None], POSE, camera)[0]
        view = CHANGES[name](View(image=spot(camera, pixel), camera=camera, cam_from_world=POSE), place())
        assert view.image.shape == (view.camera.height, view.camera.width, 3)
        expected = project(point[None], POSE, view.camera)[0]
        if name == "mirrored":  # the mirrored camera sees the mirrored pixels of the old one
            expected = np.array([camera.width, 0]) + np.array([-1, 1]) * pixel
        if np.all(expected > 12) and np.all(expected < np.array(view.image.shape[1::-1]) - 12):
            assert center(view.image) == pytest.approx(expected, abs=0.3)
            seen += 1
    assert seen > 3


@pytest.mark.parametrize("name", CHANGES)
def test_a_change_is_the_same_every_time_and_only_a_mirrored_photo_has_no_pose(name):
    view = View(image=spot(CAMERAS[0], (150, 120)), camera=CAMERAS[0], cam_from_world=POSE)
    once, again = (CHANGES[name](view, place()) for _ in range(2))
    assert np.array_equal(once.image, again.image)
    assert once.cam_from_world == (None if name == "mirrored" else POSE)


@pytest.mark.parametrize(("name", "share"), [("hidden40", 0.4), ("hidden60", 0.6)])
def test_what_hides_the_object_covers_its_share_of_where_the_object_is(name, share):
    view = View(image=gray(CAMERAS[0]), camera=CAMERAS[0], cam_from_world=POSE)
    left, top, right, bottom = object_window(view, BOX)
    changed = np.any(CHANGES[name](view, place()).image != view.image, axis=2)
    inside = changed[top:bottom, left:right]
    assert inside.sum() == changed.sum()
    rows, columns = np.any(inside, axis=1), np.any(inside, axis=0)
    assert rows.mean() * columns.mean() == pytest.approx(share, abs=0.02)


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.model.name)
def test_belief_is_off_by_as_much_as_the_disturbance_says(camera):
    for disturbance in DISTURBANCES.values():
        given = given_camera(disturbance, camera)
        assert (given is None) == (disturbance.given is None)
        if given:
            ratio = given.mean_focal_length() / camera.mean_focal_length()
            assert ratio == pytest.approx(disturbance.given)


def test_exif_of_the_right_camera_is_right_to_a_millimeter(tmp_path):
    from PIL import ExifTags, Image

    from slimsfm.exif import read_exif

    camera = with_focal_length(CAMERAS[0], 290.0)
    for name in ("exif-right", "exif-wrong"):
        disturbance = DISTURBANCES[name]
        millimeters, exif = film_focal_mm(disturbance, camera), Image.Exif()
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = millimeters
        Image.fromarray(gray(camera)).save(tmp_path / "photo.jpg", exif=exif)
        off = read_exif(tmp_path / "photo.jpg").focal_px / (disturbance.exif * camera.mean_focal_length())
        assert abs(off - 1) <= 0.51 / millimeters
