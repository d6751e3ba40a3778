"""Maps in hloc's layout, read by hloc's conventions."""

from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
import pycolmap
import pytest

from commands import contents
from scenes import like_sift
from slimsfm.errors import InputError, MapError, OutputError
from slimsfm.features import unit_rows
from slimsfm.features.store import FeatureFile
from slimsfm.geometry import corner_error
from slimsfm.mapping.hloc import read_query_names, write_hloc
from slimsfm.mapping.importing import ImportOptions, import_colmap
from slimsfm.mapping.map import PointDescriptors
from slimsfm.mapping.subset import FilteredMapping, direct_map, keep_images

NAMES = ["cam 1/front view.png", "cam 1/side.png", "cam-2/a/1.png", "cam-2/a/2.png", "x y.png", "z.png"]


def hloc_pairs(path):
    """Pairs are lines of two words; returns the references of each query."""
    references = {}
    for line in path.read_text().rstrip("\n").split("\n"):
        query, reference = line.split()
        references.setdefault(query, []).append(reference)
    return references


def hloc_keypoints_in_colmap(path, name):
    """hloc's origin is the center of the top-left pixel, COLMAP's is its corner."""
    with h5py.File(path, "r", libver="latest") as file:
        return file[name]["keypoints"][()] + 0.5


def hloc_matches(path, name0, name1):
    """A group `A/B` or `B/A`, "/" in names written "-"; -1 marks no match."""
    keys = [name.replace("/", "-") for name in (name0, name1)]
    with h5py.File(path, "r", libver="latest") as file:
        turned = "/".join(keys) not in file
        group = file["/".join(reversed(keys) if turned else keys)]
        targets, scores = group["matches0"][()], group["matching_scores0"][()]
    assert targets.shape == scores.shape
    rows = np.flatnonzero(targets != -1)
    pairs = np.stack([rows, targets[rows]], axis=1)
    return pairs[:, ::-1] if turned else pairs


def hloc_nearest(path0, name0, path1, name1):
    """Mutual nearest neighbors by the dot product of stored descriptors."""
    with h5py.File(path0, "r") as file0, h5py.File(path1, "r") as file1:
        one, other = file0[name0]["descriptors"][()], file1[name1]["descriptors"][()]
    similar = np.einsum("dn,dm->nm", one.astype(np.float32), other.astype(np.float32))
    there, back = similar.argmax(axis=1), similar.argmax(axis=0)
    return np.where(back[there] == np.arange(len(there)), there, -1)


def renamed(map_, names):
    """The same map with other names, in the same order."""
    model = pycolmap.Reconstruction(map_.model)
    new = dict(zip(map_.images, names, strict=True))
    for image in map_.images.values():
        model.image(image.image_id).name = new[image.name]
    return replace(
        map_,
        model=model,
        features={new[name]: map_.features[name] for name in map_.images},
        matches={(new[a], new[b]): pairs for (a, b), pairs in map_.matches.items()},
    )


def with_sift(map_):
    """The same map with bytes for descriptors, and scales and orientations."""
    rng = np.random.default_rng(0)

    def changed(features):
        signed = 127 + 120 * features.descriptors
        turns = rng.uniform(0.1, 2 * np.pi, len(features)).astype(np.float32)
        return replace(
            features, descriptors=signed.astype(np.uint8), frames=np.stack([1 + turns, turns], axis=1)
        )

    return replace(map_, features={name: changed(one) for name, one in map_.features.items()})


@dataclass(frozen=True)
class Exported:
    map: object
    path: Path

    @property
    def model(self):
        return pycolmap.Reconstruction(self.path / "sfm")


@pytest.fixture
def exported(exact, tmp_path):
    map_ = renamed(exact, NAMES)
    write_hloc(map_, tmp_path / "out")
    return Exported(map_, tmp_path / "out")


def test_the_folder_holds_what_hloc_needs(exported):
    held = {path.name for path in exported.path.iterdir()}
    assert held == {"sfm", "features.h5", "matches.h5", "references.txt"}
    parts = {path.name for path in (exported.path / "sfm").iterdir()}
    assert parts == {f"{part}.bin" for part in ("cameras", "frames", "images", "points3D", "rigs")}
    assert (exported.path / "references.txt").read_text().splitlines() == NAMES


def test_keypoints_of_the_model_are_rows_of_the_features(exported):
    for image in exported.model.images.values():
        keypoints = hloc_keypoints_in_colmap(exported.path / "features.h5", image.name)
        points2D = np.array([point.xy for point in image.points2D])
        assert keypoints.dtype == np.float32
        assert np.abs(keypoints - points2D).max() < 1e-3
        assert image.num_points3D == len(exported.map.observations[image.name].rows)


def test_features_have_hlocs_shapes(exported):
    with h5py.File(exported.path / "features.h5", "r") as file:
        for name, features in exported.map.features.items():
            group = file[name]
            assert group["descriptors"].shape == (32, len(features))
            assert group["scores"].shape == (len(features),)
            assert group["image_size"][()].tolist() == [640, 480]


def test_matches_are_found_in_both_orders_of_a_pair(exported):
    for (a, b), pairs in exported.map.matches.items():
        assert np.array_equal(hloc_matches(exported.path / "matches.h5", a, b), pairs)
        turned = hloc_matches(exported.path / "matches.h5", b, a)
        assert np.array_equal(turned[np.argsort(turned[:, 1])], pairs[:, ::-1])


def test_bytes_become_half_floats_of_unit_length_and_radians_degrees(exact, tmp_path):
    map_ = with_sift(exact)
    write_hloc(map_, tmp_path / "out")
    with h5py.File(tmp_path / "out" / "features.h5", "r") as file:
        for name, features in map_.features.items():
            descriptors = file[name]["descriptors"][()]
            assert descriptors.dtype == np.float16
            assert np.allclose(descriptors.T, unit_rows(features.descriptors), atol=1e-3)
            assert np.allclose(file[name]["scales"][()], features.frames[:, 0])
            assert np.allclose(file[name]["oris"][()], np.degrees(features.frames[:, 1]))
    read = FeatureFile(tmp_path / "out" / "features.h5")
    for name, features in map_.features.items():
        assert np.allclose(read[name].frames, features.frames)


def test_floats_stay_as_they_are(exported):
    with h5py.File(exported.path / "features.h5", "r") as file:
        for name, features in exported.map.features.items():
            assert np.array_equal(file[name]["descriptors"][()].T, features.descriptors)


def test_importing_the_export_restores_the_map(exact, tmp_path):
    map_, path = renamed(like_sift(exact), NAMES), tmp_path / "out"
    write_hloc(map_, path)
    files = ImportOptions(features=path / "features.h5", matches=path / "matches.h5")
    back = import_colmap(path / "sfm", options=files)
    for (a, b), pairs in map_.matches.items():
        assert np.array_equal(back.matches[a, b], pairs)
    for name, features in map_.features.items():
        assert np.allclose(back.features[name].keypoints, features.keypoints, atol=1e-4)
        assert np.allclose(back.features[name].descriptors, unit_rows(features.descriptors), atol=1e-3)
    boxed = replace(back, info=replace(back.info, box=map_.box))  # hloc stores no box
    assert boxed.fingerprint == map_.fingerprint


def test_equal_maps_give_equal_bytes(exported, tmp_path):
    write_hloc(exported.map, tmp_path / "again")
    assert contents(tmp_path / "again") == contents(exported.path)


def test_every_query_is_paired_with_every_image(exact, tmp_path):
    small = keep_images(exact, ["005.png", "002.png"])
    write_hloc(small, tmp_path / "out", ["night/2.jpg", "night/1.jpg"])
    assert (tmp_path / "out" / "references.txt").read_text() == "002.png\n005.png\n"
    paired = hloc_pairs(tmp_path / "out" / "pairs-queries.txt")
    assert paired == {query: ["002.png", "005.png"] for query in ("night/2.jpg", "night/1.jpg")}
    assert list(paired) == ["night/2.jpg", "night/1.jpg"]


def test_a_map_without_matches_is_exported_without_matches(exact, tmp_path):
    write_hloc(replace(exact, matches={}), tmp_path / "out")
    assert not (tmp_path / "out" / "matches.h5").exists()


def localize_as_hloc(path, model, query, camera, features, matches):
    """Localize like hloc's `localize_sfm`: 2D-3D matches through the references, then a pose."""
    keypoints = hloc_keypoints_in_colmap(features, query)
    ids = {image.name: image_id for image_id, image in model.images.items()}
    found = {}
    for reference in hloc_pairs(path / "pairs-queries.txt")[query]:
        image = model.images[ids[reference]]
        point3D_ids = np.array([p.point3D_id if p.has_point3D() else -1 for p in image.points2D])
        for row, target in hloc_matches(matches, query, reference):
            if point3D_ids[target] != -1:
                found.setdefault((row, point3D_ids[target]), None)
    points2D = keypoints[[row for row, _ in found]]
    points3D = np.array([model.points3D[point3D_id].xyz for _, point3D_id in found])
    return pycolmap.estimate_and_refine_absolute_pose(
        points2D, points3D, camera, estimation_options={"ransac": {"max_error": 12.0}}
    )


@pytest.mark.parametrize("stored", ["floats", "bytes"])
def test_hlocs_localization_finds_the_true_poses(exact, tmp_path, stored):
    full = exact if stored == "floats" else with_sift(exact)
    small = keep_images(full, ["001.png", "004.png"])
    queries = [name for name in full.images if name not in small.images]
    path, features, matches = (tmp_path / name for name in ("out", "queries.h5", "matches.h5"))
    write_hloc(small, path, queries)
    with h5py.File(features, "w", libver="latest") as file:
        for name in queries:
            file[f"{name}/keypoints"] = full.features[name].keypoints - 0.5
            unit = unit_rows(full.features[name].descriptors)
            file[f"{name}/descriptors"] = unit.T.astype(np.float16)
    with h5py.File(matches, "w", libver="latest") as file:
        for query, references in hloc_pairs(path / "pairs-queries.txt").items():
            for name in references:
                targets = hloc_nearest(features, query, path / "features.h5", name)
                file[f"{query}/{name}/matches0"] = targets.astype(np.int16)
                file[f"{query}/{name}/matching_scores0"] = (targets >= 0).astype(np.float16)
    model = pycolmap.Reconstruction(path / "sfm")
    for query in queries:
        found = localize_as_hloc(path, model, query, full.camera(query), features, matches)
        assert found["num_inliers"] > 100
        true = full.images[query].cam_from_world()
        assert corner_error(found["cam_from_world"], true, full.box) < 1e-5


def test_a_map_for_direct_matching_is_refused(exact, tmp_path):
    rows = np.arange(5)
    points = PointDescriptors(points=rows, descriptors=np.eye(5, 32, dtype=np.float32))
    with pytest.raises(MapError, match=r"direct matching alone.*reduce the full map for images instead"):
        write_hloc(direct_map(exact, points), tmp_path / "out")
    assert contents(tmp_path) == {}


def test_pairs_that_hloc_would_misread_are_refused(exact, tmp_path):
    with pytest.raises(InputError, match=r"'my query\.png': hloc cannot read pairs of names with spaces"):
        write_hloc(exact, tmp_path / "out", ["my query.png"])
    with pytest.raises(InputError, match=r"'cam 1/front view\.png': hloc cannot read pairs"):
        write_hloc(renamed(exact, NAMES), tmp_path / "out", ["query.png"])
    with pytest.raises(InputError, match=r"query '003\.png' has the name of an image of the map"):
        write_hloc(exact, tmp_path / "out", ["query.png", "003.png"])
    assert contents(tmp_path) == {}


def test_names_that_hloc_takes_for_one_are_refused(exact, tmp_path):
    names = ["a-b.png", "a/b.png", *NAMES[2:]]
    with pytest.raises(InputError, match=r"'a[-/]b\.png': hloc's matches cannot tell this name from another"):
        write_hloc(renamed(exact, names), tmp_path / "out")
    assert contents(tmp_path) == {}


def test_a_missing_part_leaves_nothing_behind(exact, tmp_path):
    short = replace(exact, features={**exact.features, "003.png": exact.features["003.png"][np.arange(9)]})
    with pytest.raises(MapError, match=r"'003\.png' has \d+ keypoints in the model but 9 in the features"):
        write_hloc(short, tmp_path / "out")
    assert contents(tmp_path) == {}
    (tmp_path / "out").write_text("mine")
    with pytest.raises(OutputError, match="exists already"):
        write_hloc(exact, tmp_path / "out")


def test_a_reduced_map_needs_no_features_of_dropped_images(exact, tmp_path):
    kept = FilteredMapping(exact.features, {"002.png", "003.png"}.__contains__)
    write_hloc(replace(keep_images(exact, list(kept)), features=kept), tmp_path / "out")
    with h5py.File(tmp_path / "out" / "features.h5", "r") as file:
        assert sorted(file) == ["002.png", "003.png"]
    with h5py.File(tmp_path / "out" / "matches.h5", "r") as file:
        assert list(file) == ["002.png"]


def test_names_with_line_breaks_are_refused(exact, tmp_path):
    with pytest.raises(InputError, match=r"'a\\nb\.png': a list with a name per line cannot hold it"):
        write_hloc(renamed(exact, ["a\nb.png", *list(exact.images)[1:]]), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_names_of_queries_are_read_from_folders_and_lists(tmp_path):
    folder = tmp_path / "queries"
    (folder / "night").mkdir(parents=True)
    for name in ("b.jpg", "night/a.png", "notes.txt"):
        (folder / name).touch()
    assert read_query_names(folder) == ["b.jpg", "night/a.png"]
    names = tmp_path / "names.txt"
    names.write_text("# queries\nnight/a.png\n\nb.jpg\nb.jpg\n")
    assert read_query_names(names) == ["night/a.png", "b.jpg"]
    names.write_text("night/a.png\n", "utf-8-sig")
    assert read_query_names(names) == ["night/a.png"]
    names.write_text(
        "night/a.png SIMPLE_RADIAL 640 480 500 320 240 0.1\nb.jpg PINHOLE 640 480 500 500 320 240\n"
    )
    assert read_query_names(names) == ["night/a.png", "b.jpg"]


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (None, "neither a folder of images nor a readable list"),
        (b"\x89PNG\xff\xfe", "neither a folder of images nor a readable list"),
        (b"# none\n\n", "holds no name of a query"),
        (b"a.png\nmy photo.png\n", "'my photo.png' is neither a name without spaces nor"),
    ],
    ids=["missing", "an image", "empty", "a name with a space"],
)
def test_files_that_are_not_lists_of_queries_are_refused(tmp_path, content, complaint):
    path = tmp_path / "names.txt"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=complaint) as caught:
        read_query_names(path)
    assert str(caught.value).startswith(f"{path}: ")
