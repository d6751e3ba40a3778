import shutil

import numpy as np
import pytest
from PIL import ExifTags, Image

from slimsfm.errors import ImageError, InputError, ReconstructionError
from slimsfm.mapping.build import BuildOptions, build_map
from slimsfm.mapping.masked_photos import MaskedPhotos, find_photos
from slimsfm.photos import upright

WIDTH, HEIGHT = 30, 20
KEPT = np.zeros((HEIGHT, WIDTH), np.uint8)
KEPT[2:9, 3:20] = 255


def write(path, pixels, orientation=None):
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    if orientation:
        exif[ExifTags.Base.Orientation] = orientation
    Image.fromarray(pixels).save(path, exif=exif)


def stored(pixels, orientation):
    """Stored pixels of which these are the upright ones."""
    return upright(pixels, {6: 8, 8: 6}.get(orientation, orientation))


@pytest.fixture
def folder(tmp_path):
    for name in ("a.jpg", "b.jpg", "sub/c 1.png"):
        write(tmp_path / "photos" / name, np.full((HEIGHT, WIDTH, 3), 90, np.uint8))
    return tmp_path


NAMES = ["a.jpg", "b.jpg", "sub/c 1.png"]


def photos(folder, names=NAMES, **options):
    return MaskedPhotos(folder / "photos", names, folder / "masks", **options)


@pytest.mark.parametrize("named", ["{name}.png", "{stem}.png"])
def test_masks_are_found_by_either_name(folder, named):
    for name in NAMES:
        stem = name.rpartition(".")[0]
        write(folder / "masks" / named.format(name=name, stem=stem), KEPT)
    found = photos(folder)
    assert all(np.array_equal(found.read(name).mask, KEPT) for name in NAMES)
    assert found.notes == ()
    found.keep(NAMES)


def test_the_mask_of_the_whole_name_has_priority_and_others_are_named(folder):
    write(folder / "masks" / "a.jpg.png", KEPT)
    write(folder / "masks" / "a.png", 255 - KEPT)
    write(folder / "masks" / "c 1.png", KEPT)  # not in the subfolder
    found = photos(folder)
    assert np.array_equal(found.read("a.jpg").mask, KEPT)
    assert found.read("b.jpg").mask is None
    assert found.notes == (
        "2 masks of no photo ignored: a.png, c 1.png",
        "2 photos without a mask, used whole: b.jpg, sub/c 1.png",
    )


@pytest.mark.parametrize("held", [[], ["c 1.png"]])
def test_masks_none_of_which_fits_are_an_error_that_says_how_they_are_named(folder, held):
    (folder / "masks").mkdir()
    for name in held:
        write(folder / "masks" / name, KEPT)
    with pytest.raises(InputError, match=r"masks: holds no mask.*a\.jpg is named a\.jpg\.png or a\.png"):
        photos(folder)


def test_folders_of_masks_are_apart_from_those_of_photos(folder):
    with pytest.raises(InputError, match="no such folder of masks"):
        photos(folder)
    with pytest.raises(InputError, match="photos: is the folder of the photos"):
        MaskedPhotos(folder / "photos", NAMES, folder / "photos")
    write(folder / "photos" / "masks" / "a.png", KEPT)
    assert list(find_photos(folder / "photos", folder / "photos" / "masks").names) == NAMES
    assert len(find_photos(folder / "photos", None).names) == 4


@pytest.mark.parametrize("orientation", range(2, 9))
def test_masks_turn_with_their_own_tag_or_else_with_the_photo_they_fit_only_as_stored(folder, orientation):
    photo, mask = folder / "photos" / "a.jpg", folder / "masks" / "a.png"
    write(photo, stored(np.full((HEIGHT, WIDTH, 3), 90, np.uint8), orientation), orientation)
    write(mask, stored(KEPT, orientation), orientation)
    found = photos(folder, ["a.jpg"])
    assert np.array_equal(found.read("a.jpg").mask, KEPT)
    assert found.notes == ()
    write(mask, KEPT)
    found = photos(folder, ["a.jpg"])
    assert np.array_equal(found.read("a.jpg").mask, KEPT)
    ambiguous = "1 mask taken as upright, because their photo is turned and they fit both ways: a.png"
    assert found.notes == ((ambiguous,) if orientation < 5 else ())
    if orientation >= 5:  # COLMAP's masks are in stored pixels
        write(mask, stored(KEPT, orientation))
        assert np.array_equal(photos(folder, ["a.jpg"]).read("a.jpg").mask, KEPT)


def test_a_mask_of_another_size_is_named(folder):
    write(folder / "masks" / "a.png", KEPT[:, :10])
    with pytest.raises(
        ImageError, match=r"a\.png: the mask is \(10, 20\) pixels, its upright image \(30, 20\)"
    ):
        photos(folder).read("a.jpg")


@pytest.mark.parametrize("alpha", ["mask", "ignore"])
def test_transparency_is_a_mask_unless_told_otherwise_and_combines_with_a_given_one(folder, alpha):
    pixels = np.full((HEIGHT, WIDTH, 4), 255, np.uint8)
    pixels[:, 10:, 3] = 0
    for name in ("clear.png", "masked.png"):
        write(folder / "photos" / name, pixels)
    write(folder / "photos" / "opaque.png", np.full((HEIGHT, WIDTH, 4), 255, np.uint8))
    write(folder / "masks" / "masked.png.png", KEPT)
    names = ["clear.png", "masked.png", "opaque.png"]
    found = photos(folder, names, alpha=alpha)
    clear, masked, opaque = (found.read(name).mask for name in names)
    assert opaque is None
    if alpha == "ignore":
        assert clear is None
        assert np.array_equal(masked, KEPT)
    else:
        assert np.array_equal(clear, pixels[..., 3])
        assert np.array_equal(masked, KEPT & pixels[..., 3])
        assert (
            "2 photos with transparent pixels, which hold no features: clear.png, masked.png" in found.notes
        )


def test_photos_that_are_masked_entirely_are_named(folder):
    write(folder / "photos" / "d.png", np.zeros((HEIGHT, WIDTH, 4), np.uint8))
    names = [*NAMES, "d.png"]
    for name in NAMES:
        write(folder / "masks" / f"{name}.png", 0 * KEPT if name == "b.jpg" else KEPT)
    found = photos(folder, names)
    for name in names:
        found.read(name)
    empty = "2 photos without features, because a mask or transparency covers all pixels: b.jpg, d.png"
    assert empty in found.notes
    found.keep(NAMES)
    write(folder / "masks" / "a.jpg.png", 0 * KEPT)
    found = photos(folder, names)
    for name in names:
        found.read(name)
    with pytest.raises(InputError, match=r"3 photos without features.*: a\.jpg, b\.jpg, d\.png; a map needs"):
        found.keep(names)


def test_no_observation_of_a_map_lies_on_a_transparent_pixel_and_notes_are_stored(rendered, tmp_path):
    names = rendered.names
    alpha = np.zeros((240, 320), np.uint8)
    alpha[60:180, 100:220] = 255
    for name in names:
        pixels = np.dstack([np.asarray(Image.open(rendered.folder / name)), alpha])
        write(tmp_path / "photos" / name, pixels)
    made = {
        use: build_map(tmp_path / "photos", BuildOptions(alpha=use), known=rendered.known)
        for use in ("mask", "ignore")
    }
    for use, map_ in made.items():
        seen = [map_.features[name].keypoints[map_.observations[name].rows] for name in names]
        columns, rows = np.concatenate(seen).astype(int).T
        assert (alpha[rows, columns] > 0).all() == (use == "mask")
    assert len(made["mask"].point3D_ids) > 20
    assert [note.split(":")[0] for note in made["mask"].info.notes] == [
        "8 photos with transparent pixels, which hold no features"
    ]
    assert made["ignore"].info.notes == ()


def test_what_was_skipped_is_told_with_a_failed_reconstruction_too(rendered, tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for i, name in enumerate(rendered.names[:2]):
        shutil.copy(rendered.folder / name, folder / f"{i}.png")
        (folder / f"{i}.dng").write_bytes(b"")
    mask = np.zeros((240, 320), np.uint8)
    mask[:5, :5] = 255
    for i in range(2):
        write(tmp_path / "masks" / f"{i}.png", mask)
    with pytest.raises(ReconstructionError, match=r"no model.*; 2 raw files skipped: 0\.dng, 1\.dng"):
        build_map(folder, BuildOptions(masks=tmp_path / "masks"))
