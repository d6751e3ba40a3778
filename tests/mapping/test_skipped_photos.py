"""A photo that cannot be used is skipped by name and reason, and the others do not notice."""

import logging
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from commands import contents
from slimsfm.errors import ImageError, InputError
from slimsfm.mapping.build import BuildOptions, build_map
from slimsfm.mapping.io import write_map

DAMAGED = "not a readable image: damaged"


def break_photos(folder: Path, good: bytes) -> dict[str, str]:
    """Add broken photos between the others; returns the reason of each."""
    broken = {
        "a text.jpg": b"not an image",
        "empty.png": b"",
        "take 1/cut.png": good[: len(good) // 2],
        "zeros.png": good[:300] + bytes(len(good) - 300),
    }
    for name, content in broken.items():
        (folder / name).write_bytes(content)
    return dict.fromkeys(broken, DAMAGED)


@pytest.fixture
def folder(rendered, tmp_path) -> Path:
    return Path(shutil.copytree(rendered.folder, tmp_path / "images"))


def test_broken_photos_are_named_and_the_others_give_their_map(rendered, unposed, folder, tmp_path, caplog):
    reasons = break_photos(folder, (folder / rendered.names[0]).read_bytes())
    with caplog.at_level(logging.WARNING):
        made = build_map(folder)
    assert len(caplog.messages) == len(reasons)
    for name in reasons:
        assert any(message.startswith(f"{name}: skipped: {DAMAGED}") for message in caplog.messages)
    (note,) = made.info.notes
    assert note.startswith(f"4 photos skipped: {', '.join(sorted(reasons))} ({DAMAGED}")
    assert made.unregistered == ()
    write_map(replace(made, info=replace(made.info, notes=())), tmp_path / "with")
    write_map(unposed.map, tmp_path / "without")
    assert contents(tmp_path / "with") == contents(tmp_path / "without")


def test_a_broken_mask_skips_its_photo_and_known_poses_do_without_missing_photos(rendered, folder, tmp_path):
    first, second, third, *_ = rendered.names
    for name, mask in ((first, np.zeros((24, 32), np.uint8)), (second, np.full((240, 320), 255, np.uint8))):
        path = tmp_path / "masks" / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(mask).save(path)
    (folder / third).unlink()
    made = build_map(folder, BuildOptions(masks=tmp_path / "masks"), known=rendered.known)
    assert list(made.images) == sorted({*rendered.names} - {first, third})
    wrong_size = f"1 photo skipped: {first} (its mask {first}.png: the mask is (32, 24) pixels"
    assert any(note.startswith(wrong_size) for note in made.info.notes)
    assert f"1 photo skipped: {third} (no such image)" in made.info.notes


def test_strict_stops_at_the_first_broken_photo(rendered, folder):
    path = folder / rendered.names[2]
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(ImageError, match=r"images/take 1/frame 2\.png: not a readable image"):
        build_map(folder, BuildOptions(strict=True))


def test_without_two_good_photos_there_is_an_error_with_all_reasons(folder, rendered):
    for name in rendered.names[1:]:
        (folder / name).write_bytes(b"")
    with pytest.raises(InputError, match=r"holds 1 image; a map needs.*7 photos skipped: take 1"):
        build_map(folder)
    (folder / rendered.names[0]).write_bytes(b"")
    with pytest.raises(ImageError, match=r"images: none of its images can be used; 8 photos skipped"):
        build_map(folder)
