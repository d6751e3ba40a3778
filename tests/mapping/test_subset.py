from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scenes import exact_map, with_matches
from slimsfm.errors import InputError
from slimsfm.features import Features
from slimsfm.mapping.io import read_map, write_map
from slimsfm.mapping.subset import FilteredMapping, keep_images

PARTIAL = with_matches(exact_map(8, 60, reach_deg=80))
NAMES = list(PARTIAL.images)
SUBSETS = st.sets(st.sampled_from(NAMES), min_size=1)


def parents(map_):
    """The images that observe each point, from its track."""
    names = {image.image_id: name for name, image in map_.images.items()}
    return {
        i: [(names[e.image_id], e.point2D_idx) for e in map_.model.point3D(i).track.elements]
        for i in map_.point3D_ids.tolist()
    }


@given(names=SUBSETS, min_track_length=st.integers(1, 3))
def test_points_with_enough_kept_observations_stay(names, min_track_length):
    kept = keep_images(PARTIAL, names, min_track_length=min_track_length)
    restricted = {i: [e for e in track if e[0] in names] for i, track in parents(PARTIAL).items()}
    assert parents(kept) == {i: track for i, track in restricted.items() if len(track) >= min_track_length}


@given(names=SUBSETS)
def test_kept_images_and_points_do_not_change(names):
    kept = keep_images(PARTIAL, names)
    assert list(kept.images) == sorted(names)
    assert kept.model.is_valid()
    assert kept.info is PARTIAL.info
    for name, image in kept.images.items():
        before = PARTIAL.images[name]
        assert (image.image_id, image.camera_id) == (before.image_id, before.camera_id)
        assert np.array_equal(image.cam_from_world().matrix(), before.cam_from_world().matrix())
        assert repr(kept.camera(name)) == repr(PARTIAL.camera(name))
        assert image.num_points2D() == before.num_points2D()
        assert kept.features[name] is PARTIAL.features[name]
        seen = kept.observations[name]
        pixels = image.cam_from_world() * kept.points3D_in_world[seen.points]
        assert kept.features[name].keypoints[seen.rows] == pytest.approx(
            kept.camera(name).img_from_cam(pixels), abs=1e-3
        )
    for i in kept.point3D_ids.tolist():
        assert np.array_equal(kept.model.point3D(i).xyz, PARTIAL.model.point3D(i).xyz)
        assert np.array_equal(kept.model.point3D(i).color, PARTIAL.model.point3D(i).color)
    assert set(kept.matches) == {pair for pair in PARTIAL.matches if set(pair) <= names}
    assert set(kept.features) == names


def test_keeping_all_images_changes_nothing_on_disk(tmp_path):
    write_map(PARTIAL, tmp_path / "before")
    write_map(keep_images(PARTIAL, NAMES), tmp_path / "after")
    for part in ("features.h5", "matches.h5", "map.json", "sparse/points3D.bin", "sparse/images.bin"):
        assert (tmp_path / "before" / part).read_bytes() == (tmp_path / "after" / part).read_bytes()


def test_the_order_and_duplicates_of_names_do_not_matter(tmp_path):
    write_map(keep_images(PARTIAL, NAMES[:3]), tmp_path / "a")
    write_map(keep_images(PARTIAL, [NAMES[2], NAMES[0], NAMES[2], NAMES[1]]), tmp_path / "b")
    for path in (tmp_path / "a").rglob("*.bin"):
        assert path.read_bytes() == (tmp_path / "b" / path.relative_to(tmp_path / "a")).read_bytes()


def test_keeping_in_two_steps_equals_keeping_at_once():
    twice = keep_images(keep_images(PARTIAL, NAMES[:5]), NAMES[2:4])
    assert parents(twice) == parents(keep_images(PARTIAL, NAMES[2:4]))


def test_the_map_itself_is_not_changed(tmp_path):
    write_map(PARTIAL, tmp_path / "before")
    keep_images(PARTIAL, NAMES[:1])
    write_map(PARTIAL, tmp_path / "after")
    for path in (tmp_path / "before").rglob("*.bin"):
        assert path.read_bytes() == (tmp_path / "after" / path.relative_to(tmp_path / "before")).read_bytes()


def test_unknown_names_and_an_empty_list_are_input_errors():
    with pytest.raises(InputError, match=r"'missing\.png' is not one of the 8 images"):
        keep_images(PARTIAL, [NAMES[0], "missing.png"])
    with pytest.raises(InputError, match="no image to keep was given"):
        keep_images(PARTIAL, [])


def rig_map():
    """Two cameras on a rig, which took three frames."""
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=2, num_frames_per_rig=3, num_points3D=30
    )
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(options)
    features = {
        image.name: Features(
            keypoints=np.array([p.xy for p in image.points2D], np.float32),
            descriptors=np.zeros((image.num_points2D(), 128), np.uint8),
            scores=np.ones(image.num_points2D(), np.float32),
            image_size=(1024, 768),
        )
        for image in model.images.values()
    }
    return replace(PARTIAL, model=model, features=features, matches={})


def test_one_image_of_a_frame_of_a_rig_can_be_kept(tmp_path):
    whole = rig_map()
    assert (len(whole.images), whole.model.num_frames()) == (6, 3)
    for count in (1, 2, 3):
        names = sorted(whole.images)[-count:]
        kept = keep_images(whole, names)
        write_map(kept, tmp_path / f"{count}")
        model = pycolmap.Reconstruction(tmp_path / f"{count}" / "sparse")
        assert model.is_valid()
        assert sorted(image.name for image in model.images.values()) == names
        read = read_map(tmp_path / f"{count}")
        for name in names:
            before = whole.images[name].cam_from_world().matrix()
            assert read.images[name].cam_from_world().matrix() == pytest.approx(before)
        assert len(read.point3D_ids) == 30


def test_a_filtered_mapping_reads_only_requested_values():
    class Source(dict):
        def __getitem__(self, key):
            asked.append(key)
            return super().__getitem__(key)

    asked: list[str] = []
    chosen = FilteredMapping(Source(a=1, b=2, c=3), {"a", "c"}.__contains__)
    assert list(chosen) == ["a", "c"]
    assert len(chosen) == 2
    assert "b" not in chosen
    assert asked == []
    assert chosen["c"] == 3
    assert asked == ["c"]
    with pytest.raises(KeyError):
        chosen["b"]
