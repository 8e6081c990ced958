"""Small synthetic datasets that several tests share; nothing is downloaded."""

import logging
import os
from collections.abc import Generator, Iterator
from pathlib import Path

import pytest

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as commands do, before torch is loaded

from lerobot_msdyn.augment import __main__ as augment
from lerobot_msdyn.dataset.video import ordinary_priority
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.dataset import write_dataset

logging.getLogger("lerobot").setLevel(logging.WARNING)

FRAMES, WIDTH, HEIGHT = 12, 64, 48


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol() -> Generator[None, object, object]:
    """LeRobot's tools encode AV1 in this process; what root's encoder does to it must not reach the next test."""
    with ordinary_priority():
        return (yield)


def _scenes(episodes: int) -> list:
    return [make_scene("push", 0, FRAMES, WIDTH, HEIGHT, episode=index) for index in range(episodes)]


@pytest.fixture(scope="session")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes that share one mp4 per camera: front and side, with recorded depth."""
    root = tmp_path_factory.mktemp("desk") / "desk"
    write_dataset(_scenes(3), "local/desk", root, cameras=["front", "side"], depth=True)
    return root


@pytest.fixture(scope="session")
def desk_scenes(desk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output of `augment --save_scenes true` on two of the three episodes of `desk`, front camera."""
    out = tmp_path_factory.mktemp("desk_scenes") / "new"
    flags = {
        "repo": "local/desk",
        "root": desk,
        "new_root": out,
        "episodes": "[0,1]",
        "cameras": "[front]",
        "variants": 1,
        "perturbation.azimuth_deg": 8,
        "save_scenes": "true",
        "fit.steps": 8,
        "fit.window_frames": 6,
        "scene.moving_gaussians": 500,
        "scene.moving_frames": 4,
    }
    assert augment.run([f"--{name}={value}" for name, value in flags.items()]) == 0
    return out


@pytest.fixture(scope="session")
def image_desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes whose pictures are image features, inside the parquet files: front and wrist, with depth."""
    root = tmp_path_factory.mktemp("image_desk") / "desk"
    write_dataset(_scenes(2), "local/desk", root, cameras=["front", "wrist"], depth=True, image_dtype="image")
    return root


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Recorded episodes beside the checkout, where there are any."""
    path = Path(__file__).parent.parent.parent / "shared" / "data"
    if not path.is_dir():
        pytest.skip("no recorded episodes beside the checkout")
    return path


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Priors are kept in a folder of the test run, not in the user's."""
    os.environ["LEROBOT_MSDYN_CACHE"] = str(tmp_path_factory.mktemp("cache"))


@pytest.fixture(autouse=True)
def _logging_as_before() -> Iterator[None]:
    """Benchmarks silence all logging of their process."""
    level = logging.root.manager.disable
    yield
    logging.disable(level)
