"""The gallery: every scene has a picture, on its page and in the reference, and all of them are small."""

from pathlib import Path

from test_drawings import FUNCTIONS

from experiments.scenes import page
from experiments.scenes.scenes import PICTURES

ROOT = Path(__file__).parents[1]
HERE = ROOT / "experiments" / "scenes"


def test_every_scene_has_a_picture_in_the_gallery_and_in_the_reference():
    assert PICTURES.keys() == {name.partition(".")[0] for name in FUNCTIONS}
    assert (HERE / "README.md").read_text() == page.page()
    reference = (ROOT / "docs" / "api" / "scenes.rst").read_text()
    for name, picture in PICTURES.items():
        assert (HERE / f"scenes_{name}.png").is_file()
        shown = f".. image:: ../../experiments/scenes/scenes_{name}.png\n   :alt: {picture.text}\n"
        assert shown in reference, name


def test_pictures_are_small():
    sizes = {path.name: path.stat().st_size for path in HERE.iterdir() if path.suffix == ".png"}
    assert max(sizes.values()) <= 60_000
    assert sum(sizes.values()) <= 1_500_000
