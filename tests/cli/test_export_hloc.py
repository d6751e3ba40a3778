import pycolmap
import pytest

from commands import contents, slimsfm
from scenes import like_sift
from slimsfm.mapping.io import write_map


@pytest.fixture
def map_path(exact, tmp_path):
    write_map(exact, tmp_path / "map")
    return tmp_path / "map"


@pytest.fixture
def queries(tmp_path):
    path = tmp_path / "queries.txt"
    path.write_text(
        "night/1.jpg PINHOLE 640 480 500 500 320 240\nnight/2.jpg PINHOLE 640 480 500 500 320 240\n"
    )
    return path


def test_a_slim_map_is_exported_with_the_pairs_of_its_queries(map_path, queries, tmp_path):
    small, out = tmp_path / "small", tmp_path / "out"
    assert slimsfm("reduce", map_path, "-o", small, "--images", "002.png", "004.png").code == 0
    outcome = slimsfm("export", "hloc", small, "-o", out, "--queries", queries)
    assert (outcome.code, outcome.err) == (0, "")
    assert f"{out}: 2 images, 120 points, 4 pairs of 2 queries in " in outcome.out
    assert f"features_ref={out / 'features.h5'}" in outcome.out
    assert pycolmap.Reconstruction(out / "sfm").num_reg_images() == 2
    assert len((out / "pairs-queries.txt").read_text().splitlines()) == 4
    assert slimsfm("export", "hloc", small, "-o", out).code == 2
    assert slimsfm("export", "hloc", small, "-o", out, "--overwrite").code == 0
    assert not (out / "pairs-queries.txt").exists()


def test_an_exported_map_can_be_imported_again(exact, tmp_path):
    map_path, out, back = (tmp_path / name for name in ("map", "out", "back"))
    write_map(like_sift(exact), map_path)
    assert slimsfm("export", "hloc", map_path, "-o", out).code == 0
    files = ("--features", out / "features.h5", "--matches", out / "matches.h5")
    outcome = slimsfm("import", out / "sfm", "-o", back, *files)
    assert outcome.code == 0, outcome.err
    assert contents(back)["matches.h5"] == contents(map_path)["matches.h5"]


def test_wrong_inputs_are_reported_in_one_line(map_path, queries, tmp_path):
    direct = tmp_path / "direct"
    assert slimsfm("reduce", map_path, "-o", direct, "--max-points", 60, "--selector", "kcover").code == 0
    (tmp_path / "own.txt").write_text("003.png\n")
    before = contents(tmp_path)
    out = ("-o", tmp_path / "out")
    for arguments, naming in (
        ((direct, *out), "reduce the full map for images instead"),
        ((tmp_path / "nowhere", *out), f"{tmp_path / 'nowhere'}: not a map"),
        ((map_path, *out, "--queries", tmp_path / "nobody"), f"{tmp_path / 'nobody'}: neither a folder"),
        ((map_path, *out, "--queries", tmp_path / "own.txt"), "'003.png' has the name of an image"),
        ((map_path, "-o", map_path, "--overwrite"), "is or contains the input"),
        ((map_path, "-o", queries, "--queries", queries, "--overwrite"), "is or contains the input"),
        ((map_path,), "see slimsfm export hloc --help"),
    ):
        outcome = slimsfm("export", "hloc", *arguments)
        assert outcome.code == 2
        assert len(outcome.err.splitlines()) == 1
        assert naming in outcome.err
    assert contents(tmp_path) == before


@pytest.mark.parametrize("kind", ["superpoint", "nerf"])
def test_an_unknown_kind_is_answered_by_the_known_ones(tmp_path, kind):
    outcome = slimsfm("export", kind, "-o", tmp_path / "x")
    assert outcome.code == 2
    known = "onnx, colmap, hloc"
    assert outcome.err == f"slimsfm: {kind!r} is not a subcommand of export; choose one of {known}\n"


@pytest.mark.parametrize("arguments", [(), ("--help",), ("-h",)], ids=str)
def test_both_kinds_are_listed(arguments):
    outcome = slimsfm("export", *arguments)
    assert outcome.code == 0
    assert outcome.out.startswith("usage: slimsfm export ")
    assert "  export onnx " in outcome.out
    assert "  export hloc " in outcome.out
