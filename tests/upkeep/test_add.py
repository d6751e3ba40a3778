import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import slimsfm
from rendered import rendered
from slimsfm.errors import ImageError, InputError, MapError
from slimsfm.execution import processes
from slimsfm.geometry import corner_error
from slimsfm.graph import GraphOptions, compute_graph, load_or_compute_graph
from slimsfm.mapping.io import read_map, write_map
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import keep_images
from slimsfm.reduction import ReduceOptions
from slimsfm.reduction.repetition import repeated_options, with_parent
from slimsfm.upkeep.add import Addition, AddOptions, add
from slimsfm.upkeep.coverage import coverage
from slimsfm.upkeep.writing import write_addition


class Half:
    """Every third image of a rendered object's map was taken out, and is to be added again."""

    def __init__(self, folder: Path, basetemp: Path) -> None:
        made = rendered(basetemp / "rendered")
        self.full, self.source = made.map, made.photos
        self.taken = list(self.full.images)[1::3]
        self.path = folder / "map"
        kept = set(self.full.images) - set(self.taken)
        write_map(keep_images(self.full, kept, min_track_length=2), self.path)
        load_or_compute_graph(read_map(self.path), self.path)
        self.photos = self.some(self.taken, folder / "photos")
        self.addition = add(self.map, self.photos)
        self.larger = folder / "larger"
        write_addition(self.addition, self.map, self.path, self.larger)

    @property
    def map(self):
        return read_map(self.path)

    def error(self, larger: Map, name: str) -> float:
        """Relative corner error of an added image."""
        true = self.full.images[name].cam_from_world()
        return corner_error(larger.images[name].cam_from_world(), true, self.full.box)

    def some(self, names, folder: Path) -> Path:
        for name in names:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(self.source / name, folder / name)
        return folder


@pytest.fixture(scope="module")
def half(tmp_path_factory) -> Half:
    return Half(tmp_path_factory.mktemp("half"), tmp_path_factory.getbasetemp())


def noise(folder: Path, names) -> Path:
    """Photos of another place, which see each other."""
    folder.mkdir(parents=True, exist_ok=True)
    texture = np.random.default_rng(0).integers(0, 256, (60, 90, 3), np.uint8)
    large = np.kron(texture, np.ones((6, 6, 1), np.uint8))
    for shift, name in enumerate(names):
        Image.fromarray(large[8 * shift :][:240, 8 * shift :][:, :320]).save(folder / name)
    return folder


def same_bytes(a: Path, b: Path) -> bool:
    files = [sorted(p.relative_to(one) for p in one.rglob("*") if p.is_file()) for one in (a, b)]
    return files[0] == files[1] and all((a / p).read_bytes() == (b / p).read_bytes() for p in files[0])


def test_photos_are_added_where_they_were(half):
    found = half.addition
    assert found.added == tuple(half.taken)
    assert not found.left_out
    for name in half.taken:
        assert half.error(found.map, name) < 0.01
        assert found.map.images[name].camera_id == half.full.images[name].camera_id
        assert len(found.map.observations[name].rows) > 0.7 * len(half.full.observations[name].rows)


def test_old_images_keep_every_bit(half):
    before, after = half.map, read_map(half.larger)
    for name, image in before.images.items():
        assert np.array_equal(after.images[name].cam_from_world().matrix(), image.cam_from_world().matrix())
        assert after.images[name].image_id == image.image_id
        assert repr(after.camera(name)) == repr(before.camera(name))
    ids = before.point3D_ids.tolist()
    assert set(ids) <= set(after.point3D_ids.tolist())
    assert all(np.array_equal(after.model.point3D(i).xyz, before.model.point3D(i).xyz) for i in ids)


def test_the_map_says_what_was_added(half):
    info, before = read_map(half.larger).info, half.map.info
    assert info.origin == f"{before.origin}, {len(half.taken)} added"
    assert info.quality is not None
    assert info.quality.registered == len(half.full.images)
    again = add(read_map(half.larger), half.some(half.taken[:1], half.path.parent / "one"))
    assert again.map.info.origin == info.origin


def test_coverage_grows(half):
    assert half.addition.before == coverage(half.map)
    assert half.addition.after.views > half.addition.before.views
    assert half.addition.after.points >= half.addition.before.points


def test_the_same_photos_again_change_nothing(half, tmp_path):
    larger = read_map(half.larger)
    again = add(larger, half.photos)
    assert (again.added, again.known, again.left_out) == ((), tuple(half.taken), {})
    assert again.map is larger
    write_addition(again, larger, half.larger, tmp_path / "same")
    assert same_bytes(half.larger, tmp_path / "same")


def test_workers_and_interruptions_change_no_byte(half, tmp_path):
    photos = half.some(half.taken[:4], tmp_path / "photos")
    one = add(half.map, photos)
    executor = partial(processes, 2)

    def stop(items, label):
        for number, item in enumerate(items):
            if "match" in label and number:
                raise KeyboardInterrupt
            yield item

    with pytest.raises(KeyboardInterrupt):
        add(half.map, photos, workspace=tmp_path / "work", progress=stop)
    assert list((tmp_path / "work" / "extracted").iterdir())
    other = add(half.map, photos, workspace=tmp_path / "work", open_executor=executor, min_seconds=0.0)
    for found, name in ((one, "one"), (other, "other")):
        write_map(found.map, tmp_path / name)
    assert same_bytes(tmp_path / "one", tmp_path / "other")


def test_photos_enter_when_their_neighbors_have(half, tmp_path):
    """The map sees one side; photos all around follow each other."""
    names = list(half.full.images)
    side = keep_images(half.full, names[:6], min_track_length=2)
    found = add(side, half.some(names[6:16:2], tmp_path / "photos"))
    assert found.rounds > 1
    assert len(found.added) > 1
    for name in found.added:
        assert half.error(found.map, name) < 0.05


def test_photos_that_only_see_each_other_never_enter(half, tmp_path):
    photos = noise(tmp_path / "photos", ["x.png", "y.png", "z.png"])
    half.some(half.taken[:1], photos)
    found = add(half.map, photos)
    assert found.added == (half.taken[0],)
    assert sorted(found.left_out) == ["x.png", "y.png", "z.png"]
    assert found.map.unregistered == ("x.png", "y.png", "z.png")
    assert all(found.left_out.values())


def test_photos_of_another_place_are_refused(half, tmp_path):
    with pytest.raises(InputError, match=r"none of 2 photos could be added.*\(x.png"):
        add(half.map, noise(tmp_path / "photos", ["x.png", "y.png"]))


def test_unreadable_photos_are_skipped_by_name(half, tmp_path):
    photos = half.some(half.taken[:1], tmp_path / "photos")
    (photos / "broken.png").write_bytes(b"no image")
    found = add(half.map, photos)
    assert found.added == (half.taken[0],)
    assert any("broken.png" in note for note in found.notes)
    assert any("broken.png" in note for note in found.map.info.notes)
    with pytest.raises(ImageError, match="broken"):
        add(half.map, photos, AddOptions(strict=True))


def test_another_photo_of_a_name_in_the_map_is_refused(half, tmp_path):
    old, new = next(iter(half.map.images)), half.taken[0]
    photos = half.some([new], tmp_path / "photos")
    (photos / old).parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(half.source / half.taken[-1], photos / old)
    with pytest.raises(InputError, match="another image of this name"):
        add(half.map, photos)


def test_a_folder_without_photos_is_refused(half, tmp_path):
    with pytest.raises(InputError, match=str(tmp_path)):
        add(half.map, tmp_path)
    with pytest.raises(InputError, match="missing"):
        add(half.map, tmp_path / "missing")


def test_one_photo_is_added(half):
    name = half.taken[0]
    photo = half.some([name], half.path.parent / "alone") / name
    assert add(half.map, photo).added == (photo.name,)


def test_an_extractor_option_that_is_unknown_is_named(half):
    map_ = half.map
    odd = replace(map_, info=replace(map_.info, extractor_options={"octaves": 3}))
    with pytest.raises(InputError, match="octaves"):
        add(odd, half.photos)


def test_features_are_extracted_as_those_of_the_map(half, tmp_path):
    map_ = half.map
    few = {**map_.info.extractor_options, "max_features": 100}
    found = add(
        replace(map_, info=replace(map_.info, extractor_options=few)),
        half.some(half.taken[:1], tmp_path / "photos"),
        AddOptions(min_confidence=0.0),
    )
    assert all(len(found.map.features[name]) <= 100 for name in found.added)


def test_reduced_maps_name_the_map_that_they_were_made_from(half, tmp_path):
    full, options = half.map, ReduceOptions(for_="images", seed=3)
    slim = keep_images(with_parent(full, half.path, tmp_path / "slim", options), list(full.images)[:8])
    write_map(slim, tmp_path / "slim")
    slim = read_map(tmp_path / "slim")
    with pytest.raises(MapError, match="reduced map"):
        add(slim, half.photos)
    assert repeated_options(slim, tmp_path / "slim", read_map(half.larger)) == options
    with pytest.raises(InputError, match="does not say how"):
        repeated_options(full, half.path, full)
    with pytest.raises(InputError, match="another map"):
        repeated_options(slim, tmp_path / "slim", keep_images(full, list(full.images)[4:]))


def test_refining_moves_old_images_and_says_how_far(half):
    photos = half.some(half.taken[:2], half.path.parent / "two")
    found = add(half.map, photos, AddOptions(refine=True))
    assert found.movement is not None
    assert 0 < found.movement.median <= found.movement.largest < 0.02
    assert found.movement.image in half.map.images


def test_graphs_are_extended_and_not_computed_again(half):
    before = load_or_compute_graph(half.map, half.path)
    extended = load_or_compute_graph(read_map(half.larger), half.larger)
    assert "read" in extended.seconds
    names = {name: row for row, name in enumerate(extended.graph.names)}
    rows = [names[name] for name in before.graph.names]
    assert np.array_equal(extended.graph.dense()[np.ix_(rows, rows)], before.graph.dense())
    new = [names[name] for name in half.taken]
    whole = compute_graph(read_map(half.larger), GraphOptions()).graph.dense()
    assert np.array_equal(extended.graph.dense()[new], whole[new])


def test_wrong_options_are_named():
    with pytest.raises(ValueError, match="min_confidence"):
        AddOptions(min_confidence=2.0)
    with pytest.raises(ValueError, match="seed"):
        AddOptions(seed=-1)
    assert slimsfm.add is add
    assert slimsfm.Addition is Addition
