# Tests of docs/pictures.py
"""The repository stays small: its pictures, films and notebooks, and the programs that write them."""

from __future__ import annotations

import hashlib
import importlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "docs"))
pictures = importlib.import_module("pictures")


@pytest.fixture(scope="module")
def tree() -> list[Path]:
    """The files of the repository, with new ones that git does not ignore."""
    if not (ROOT / ".git").exists():
        pytest.skip("no git repository: other files may lie in the folder")
    listed = subprocess.run(
        ["git", "-C", ROOT, "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        capture_output=True,
    )
    assert listed.returncode == 0, listed.stderr
    return [
        path
        for name in listed.stdout.decode().split("\0")
        if name and (path := ROOT / name).is_file()
    ]


def test_all_files_together_have_at_most_14_megabytes(tree: list[Path]) -> None:
    sizes = {path.relative_to(ROOT).as_posix(): path.stat().st_size for path in tree}
    largest = sorted(sizes, key=sizes.__getitem__, reverse=True)[:5]
    assert sum(sizes.values()) <= 14_000_000, {name: sizes[name] for name in largest}


def test_no_file_is_there_twice(tree: list[Path]) -> None:
    files: dict[str, Path] = {}
    for path in tree:
        if path.stat().st_size > 100:  # empty modules are alike
            first_path = files.setdefault(hashlib.sha256(path.read_bytes()).hexdigest(), path)
            assert first_path == path, f"{path} is {first_path}"


def test_pictures_and_films_of_the_pages_are_small_webp() -> None:
    folders = (ROOT / "docs" / "images", ROOT / "docs" / "landscape" / "plots")
    files = [path for folder in folders for path in folder.rglob("*.*")]
    assert len(files) > 30
    films = 0
    for path in files:
        assert path.suffix == ".webp", path
        with Image.open(path) as picture:
            assert picture.format == "WEBP", path
            films += picture.n_frames > 1
        assert path.stat().st_size <= 500_000, path
    assert films >= 8


def moving(count: int, size: tuple[int, int] = (60, 40)) -> list[Image.Image]:
    """Frames of noise, of which no two are alike."""
    noise = np.random.default_rng(1)
    return [
        Image.fromarray(noise.integers(0, 256, (size[1], size[0], 3), dtype=np.uint8))
        for _ in range(count)
    ]


def test_a_film_keeps_its_speed_and_its_proportions(tmp_path: Path) -> None:
    path = tmp_path / "film.webp"
    pictures.write_film(moving(5), 5 * [1000 / 12], path, width=30)
    with Image.open(path) as film:
        assert film.size == (30, 20)
        assert film.info["loop"] == 0
    frames, durations = pictures.read_film(path)
    assert len(frames) == 5
    assert set(durations) <= {83, 84}
    assert sum(durations) == 417


def test_a_film_that_is_too_large_is_rejected_and_not_written(tmp_path: Path) -> None:
    path = tmp_path / "film.webp"
    with pytest.raises(
        pictures.PictureError, match="at most 500,000 are allowed: use fewer frames per second"
    ):
        pictures.write_film(moving(8, (400, 400)), 8 * [100], path)
    assert not path.exists()


def test_a_picture_of_few_colours_is_stored_exactly_and_others_nearly(tmp_path: Path) -> None:
    few_colours = np.random.default_rng(2).integers(0, 16, (30, 40, 1), dtype=np.uint8) * np.array(
        [16, 8, 4], np.uint8
    )
    ramp = np.stack(np.meshgrid(np.arange(256), np.arange(256)), axis=-1).astype(np.uint8)
    colourful = np.concatenate([ramp, np.full((256, 256, 1), 90, np.uint8)], axis=-1)
    for pixels, error in ((few_colours, 0), (colourful, 16)):
        path = tmp_path / "picture.webp"
        pictures.write_picture(Image.fromarray(pixels), path)
        with Image.open(path) as stored:
            pixels_of_file = np.asarray(stored.convert("RGB")).astype(int)
        assert pixels_of_file.shape == pixels.shape
        assert np.abs(pixels_of_file - pixels).max() <= error
        assert len(np.unique(pixels_of_file.reshape(-1, 3), axis=0)) <= 256


def test_the_command_writes_films_pictures_and_stills(tmp_path: Path) -> None:
    source = tmp_path / "film.gif"
    first, *others = (Image.new("RGB", (20, 10), (50 * i, 0, 0)) for i in range(5))
    first.save(source, save_all=True, append_images=others, duration=100)
    still, film = tmp_path / "still.webp", tmp_path / "film.webp"
    pictures.main([str(source), str(still), "--still"], standalone_mode=False)
    pictures.main([str(source), str(film), "--width", "10"], standalone_mode=False)
    with Image.open(still) as picture:
        assert (picture.size, picture.n_frames) == ((20, 10), 1)
        assert picture.convert("RGB").getpixel((0, 0)) == (100, 0, 0)
    with Image.open(film) as picture:
        assert picture.size == (10, 5)
        assert picture.n_frames == 5
    assert sum(pictures.read_film(film)[1]) == 500
