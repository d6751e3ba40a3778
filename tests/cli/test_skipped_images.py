"""What the commands say about photos that they skip."""

import json
import shutil

from commands import slimsfm


def test_localize_counts_what_it_skips_and_refuses_only_if_nothing_is_left(boulder, tmp_path):
    folder, output = tmp_path / "queries", tmp_path / "poses.json"
    folder.mkdir()
    (folder / "a.png").write_bytes(b"")
    nothing = slimsfm("localize", boulder.map_path, folder, "-o", output)
    assert (nothing.code, output.exists()) == (2, False)
    shutil.copy(boulder.query.image_paths[0], folder / "b.png")
    done = slimsfm("localize", boulder.map_path, folder, "-o", output)
    assert done.code == 0
    assert "a.png: skipped: not a readable image" in done.out
    assert f"{output}: 1 of 2 images localized, 1 skipped in " in done.out
    images = {one["name"]: one for one in json.loads(output.read_text())["images"]}
    assert (images["a.png"]["localized"], images["a.png"]["matches"]) == (False, 0)
    assert images["a.png"]["reason"].startswith("not a readable image")
    assert (images["b.png"]["localized"], images["b.png"]["reason"]) == (True, None)
    strict = slimsfm("localize", boulder.map_path, folder, "-o", tmp_path / "strict.json", "--strict")
    assert (strict.code, (tmp_path / "strict.json").exists()) == (2, False)


def test_build_leaves_nothing_behind_where_every_photo_is_broken(tmp_path):
    (tmp_path / "photos").mkdir()
    for name in ("a.jpg", "b.jpg"):
        (tmp_path / "photos" / name).write_bytes(b"text")
    done = slimsfm("build", tmp_path / "photos", "-o", tmp_path / "new" / "map")
    assert done.code == 2
    assert "none of its images can be used; 2 photos skipped: a.jpg, b.jpg (not a readable image" in done.err
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]
