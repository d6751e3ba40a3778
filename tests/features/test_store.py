import h5py
import numpy as np
import pytest

from slimsfm.errors import InputError
from slimsfm.features import Features
from slimsfm.features.store import (
    FeatureFile,
    FeatureWriter,
    MatchFile,
    indistinct_names,
    stored_name,
    write_matches,
)

NAMES = ["a b.png", "cam-1/x.png", "cam/1/ä y.png", "z.jpg"]


def random_features(seed, count=7, kind=np.uint8):
    rng = np.random.default_rng(seed)
    return Features(
        keypoints=rng.integers(0, 4000, (count, 2)).astype(np.float32) / 8,
        descriptors=rng.integers(0, 255, (count, 16)).astype(kind),
        scores=rng.random(count, np.float32),
        image_size=(640, 480 + seed),
    )


def write(path, features):
    with FeatureWriter(path) as writer:
        for name, one in features.items():
            writer.write(name, one)


@pytest.fixture
def stored(tmp_path):
    features = {name: random_features(seed) for seed, name in enumerate(reversed(NAMES))}
    write(tmp_path / "features.h5", features)
    return tmp_path / "features.h5", features


@pytest.mark.parametrize("kind", [np.uint8, np.float16, np.float32])
@pytest.mark.parametrize("count", [0, 1, 5])
def test_features_come_back_as_they_were(tmp_path, kind, count):
    features = {name: random_features(seed, count, kind) for seed, name in enumerate(NAMES)}
    write(tmp_path / "features.h5", features)
    read = FeatureFile(tmp_path / "features.h5")
    assert list(read) == NAMES
    assert len(read) == len(NAMES)
    for name, one in features.items():
        assert np.array_equal(read[name].keypoints, one.keypoints)
        assert np.array_equal(read[name].descriptors, one.descriptors)
        assert read[name].descriptors.dtype == kind
        assert np.array_equal(read[name].scores, one.scores)
        assert read[name].image_size == one.image_size
        assert read.count(name) == count


def test_the_file_is_laid_out_as_hloc_does(stored):
    path, features = stored
    with h5py.File(path, "r") as file:
        for name, one in features.items():
            group = file[name]
            assert np.array_equal(group["keypoints"][()], one.keypoints - 0.5)
            assert np.array_equal(group["descriptors"][()], one.descriptors.T)
            assert group["scores"].shape == (7,)
            assert group["image_size"][()].tolist() == list(one.image_size)


def test_files_of_hloc_are_read_with_half_precision_and_without_scores(tmp_path):
    with h5py.File(tmp_path / "features.h5", "w") as file:
        group = file.create_group("db/1.jpg")
        group["keypoints"] = np.array([[0, 0], [10.25, 20.5]], np.float16)
        group["descriptors"] = np.eye(4, 2, dtype=np.float16)
        group["image_size"] = np.array([64, 48])
    one = FeatureFile(tmp_path / "features.h5")["db/1.jpg"]
    assert one.keypoints.tolist() == [[0.5, 0.5], [10.75, 21.0]]
    assert one.descriptors.shape == (2, 4)
    assert one.scores.tolist() == [1, 1]
    assert one.image_size == (64, 48)


def test_equal_features_give_equal_bytes(stored, tmp_path):
    path, features = stored
    write(tmp_path / "again.h5", features)
    assert path.read_bytes() == (tmp_path / "again.h5").read_bytes()


def test_who_reads_a_file_is_not_disturbed_by_its_replacement(stored):
    path, features = stored
    read = FeatureFile(path)
    write(path, {"z.jpg": random_features(9)})
    assert np.array_equal(read["a b.png"].keypoints, features["a b.png"].keypoints)
    assert list(FeatureFile(path)) == ["z.jpg"]


def test_an_unknown_name_is_a_key_error(stored):
    read = FeatureFile(stored[0])
    assert "cam" not in read
    with pytest.raises(KeyError):
        read["missing.png"]


def delete(dataset):
    def damage(file):
        del file["z.jpg"][dataset]

    return damage


def put(dataset, value):
    def damage(file):
        del file["z.jpg"][dataset]
        file["z.jpg"][dataset] = value

    return damage


DAMAGES = {
    "no descriptors": delete("descriptors"),
    "a feature less": put("keypoints", np.zeros((6, 2))),
    "a score less": put("scores", np.zeros(6)),
    "one column": put("keypoints", np.zeros((7, 1))),
    "flat keypoints": put("keypoints", np.zeros(14)),
    "scalar keypoints": put("keypoints", 3.0),
    "flat descriptors": put("descriptors", np.zeros(7)),
    "words": put("keypoints", "hello"),
    "half a size": put("image_size", [640]),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES.keys())
def test_damaged_features_are_named(stored, damage):
    with h5py.File(stored[0], "r+") as file:
        damage(file)
    read = FeatureFile(stored[0])
    assert len(read["a b.png"]) == 7
    with pytest.raises(InputError, match=r"features of 'z\.jpg' are damaged"):
        read["z.jpg"]


@pytest.mark.parametrize("open_file", [FeatureFile, lambda path: MatchFile(path, NAMES)])
def test_a_file_cut_short_is_an_input_error(stored, open_file):
    path, _ = stored
    whole = path.read_bytes()
    for length in range(0, len(whole), len(whole) // 20):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"features\.h5: not a readable HDF5 file"):
            open_file(path)
    path.unlink()
    with pytest.raises(InputError, match="no such file"):
        open_file(path)


def test_matches_come_back_as_they_were(tmp_path):
    rng = np.random.default_rng(0)
    counts = dict(zip(NAMES, (9, 12, 40_000, 3), strict=True))
    matches = {}
    for a, b in [(NAMES[2], NAMES[0]), (NAMES[0], NAMES[1]), (NAMES[1], NAMES[2]), (NAMES[1], NAMES[3])]:
        size = min(counts[a], counts[b], 5)
        rows = np.sort(rng.permutation(counts[a])[:size])
        matches[a, b] = np.stack([rows, rng.permutation(counts[b])[:size]], axis=1).astype(np.int64)
    write_matches(tmp_path / "matches.h5", matches, counts)
    read = MatchFile(tmp_path / "matches.h5", NAMES, counts)
    assert list(read) == sorted(matches)
    assert len(read) == 4
    for pair, expected in matches.items():
        assert np.array_equal(read[pair], expected)
    with pytest.raises(KeyError):
        read[NAMES[0], NAMES[2]]
    with h5py.File(tmp_path / "matches.h5") as file:  # as hloc names pairs
        assert file["cam-1-x.png/cam-1-ä y.png/matches0"].shape == (12,)
    assert list(MatchFile(tmp_path / "matches.h5", NAMES[:2])) == [(NAMES[0], NAMES[1])]


def test_damaged_matches_are_named(tmp_path):
    with h5py.File(tmp_path / "matches.h5", "w") as file:
        file.create_group("a.png/b.png").create_group("matches0")
    read = MatchFile(tmp_path / "matches.h5", ["a.png", "b.png"])
    with pytest.raises(InputError, match=r"matches of \('a\.png', 'b\.png'\) are damaged"):
        read["a.png", "b.png"]


SPELLINGS = ["/abs/x.jpg", "./x.jpg", "a//x.jpg", "b/./x.jpg", "plain.jpg"]


def test_names_that_hdf5_spells_otherwise_come_back(tmp_path):
    features = {name: random_features(seed) for seed, name in enumerate(SPELLINGS)}
    write(tmp_path / "features.h5", features)
    read = FeatureFile(tmp_path / "features.h5", SPELLINGS)
    assert list(read) == sorted(SPELLINGS)
    for name, one in features.items():
        assert name in read
        assert read.count(name) == len(one)
        assert np.array_equal(read[name].keypoints, one.keypoints)
    assert list(FeatureFile(tmp_path / "features.h5")) == sorted(map(stored_name, SPELLINGS))
    counts = dict.fromkeys(SPELLINGS, 7)
    matches = {(SPELLINGS[0], SPELLINGS[1]): np.array([[1, 2], [3, 0]])}
    write_matches(tmp_path / "matches.h5", matches, counts)
    assert np.array_equal(
        MatchFile(tmp_path / "matches.h5", SPELLINGS)[next(iter(matches))], [[1, 2], [3, 0]]
    )


def test_matches_tell_names_apart_that_hloc_does_not(tmp_path):
    names = ["a-b.png", "a/b.png", "a-b/c.png", "a/b/c.png", "a/b-c.png"]
    assert indistinct_names(names) == sorted(names)
    assert indistinct_names(NAMES) == []
    pairs = [(a, b) for a in names for b in names if a < b]
    matches = {pair: np.array([[i, i]]) for i, pair in enumerate(pairs)}
    write_matches(tmp_path / "matches.h5", matches, dict.fromkeys(names, len(pairs)))
    read = MatchFile(tmp_path / "matches.h5", names[::-1])
    assert {pair: read[pair].tolist() for pair in read} == {pair: [[i, i]] for i, pair in enumerate(pairs)}


def test_old_names_of_pairs_are_read(tmp_path):
    names = ["db_1/a.png", "db_1_a.png", "q_.png", "z.png"]
    pairs = [(a, b) for a in names for b in names if a < b]
    with h5py.File(tmp_path / "matches.h5", "w") as file:
        for i, (a, b) in enumerate([*pairs, ("other_a.png", "z.png")]):
            targets = np.full(9, -1)
            targets[i % 9] = 3
            file[f"{a.replace('/', '-')}_{b.replace('/', '-')}/matches0"] = targets
    read = MatchFile(tmp_path / "matches.h5", names)
    assert {pair: read[pair].tolist() for pair in read} == {pair: [[i, 3]] for i, pair in enumerate(pairs)}
    assert read.num_other_pairs == 1


def test_a_pair_that_can_be_read_in_two_ways_is_no_pair(tmp_path):
    with h5py.File(tmp_path / "matches.h5", "w") as file:
        file["a_b_c/matches0"] = np.array([0])
    assert list(MatchFile(tmp_path / "matches.h5", ["a", "b_c"])) == [("a", "b_c")]
    assert list(MatchFile(tmp_path / "matches.h5", ["a", "b_c", "a_b", "c"])) == []


def test_matches_of_an_image_with_itself_are_no_pair(tmp_path):
    write_matches(tmp_path / "m.h5", {("a", "b"): np.array([[0, 1]])}, {"a": 3, "b": 3})
    with h5py.File(tmp_path / "m.h5", "r+") as file:
        file["a/a/matches0"] = np.zeros(3, np.int16)
    found = MatchFile(tmp_path / "m.h5", ["a", "b"])
    assert (list(found), found.num_other_pairs) == ([("a", "b")], 1)
