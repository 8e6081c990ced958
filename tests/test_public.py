"""The public names are exactly these, and none hides a module of the package."""

import pkgutil

import pytest

import lerobot_msdyn

NAMES = [
    "CameraTrack",
    "DynamicScene",
    "Episode",
    "Gaussians",
    "MixedViews",
    "MsdynError",
    "OutputDataset",
    "Priors",
    "Recipe",
    "augment_episode",
    "estimate_priors",
    "fit",
    "initialise",
    "load_recipe",
    "load_scene",
    "open_source",
    "rasterize",
    "read_episode",
    "reconstruct",
    "render_frames",
    "save_scene",
]


def test_public_names() -> None:
    assert lerobot_msdyn.__all__ == NAMES
    assert dir(lerobot_msdyn) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_public_name_is_documented(name: str) -> None:
    assert getattr(lerobot_msdyn, name).__doc__


def test_no_public_name_hides_a_module() -> None:
    assert not {module.name for module in pkgutil.iter_modules(lerobot_msdyn.__path__)} & set(NAMES)


def test_unknown_name() -> None:
    with pytest.raises(AttributeError, match="no attribute 'absent'"):
        _ = lerobot_msdyn.absent
