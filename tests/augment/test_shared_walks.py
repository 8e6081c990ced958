"""Two recordings by a camera that walks through one world, end to end: what one never shows is taken from the other."""

import dataclasses
import json
import shutil
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from augment_command import FRONT, run
from walking import FRAMES, HEIGHT, WIDTH, walk_along

from lerobot_msdyn.augment import backgrounds
from lerobot_msdyn.augment import run as job
from lerobot_msdyn.augment.backgrounds import seen_together
from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.dataset.read import open_source
from lerobot_msdyn.priors.exchange import Exchange, write_exchange
from lerobot_msdyn.synthetic.dataset import write_dataset
from lerobot_msdyn.synthetic.viewpoints import walking_camera

ARCS = ((-25.0, -5.0), (-10.0, 15.0))  # degrees of azimuth
FAST = ["--fit.steps", "20", "--scene.moving_frames", "4", "--scene.moving_gaussians", "500", "--variants", "1"]


@pytest.fixture(scope="module")
def walks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the dataset, with recorded depth, and a file of poses and masks for each episode."""
    folder = tmp_path_factory.mktemp("walks")
    scenes = []
    for episode, arc in enumerate(ARCS):
        scene, view, priors = walk_along(arc, episode=episode)
        scenes.append(dataclasses.replace(scene, cameras={"front": view.camera}))
        camera = view.camera
        for kind, world in (("shared", "desk"), ("own", "")):
            content = Exchange(
                FRAMES,
                HEIGHT,
                WIDTH,
                episode,
                FRONT,
                masks=priors.instances.numpy(),
                K=camera.intrinsics.numpy(),
                w2c=camera.camera_from_world.numpy(),
                world=world,
            )
            write_exchange(folder / kind / f"{episode}.npz", content)
    write_dataset(scenes, "local/walks", folder / "walks", depth=True)
    return folder


def command(walks: Path, out: Path, *more: str, kind: str = "shared") -> list[str]:
    """New views from 14 degrees further on than the first episode was recorded."""
    recorded, aside = (walking_camera(3, WIDTH, HEIGHT, (ARCS[0][0] + by, ARCS[0][1] + by)) for by in (0, 14))
    pose = (aside.camera_from_world.double() @ recorded.world_from_camera.double())[1, :3].reshape(-1).tolist()
    source = ["--repo", "local/walks", "--root", str(walks / "walks"), "--new_root", str(out), "--episodes", "[0]"]
    file = f"{walks}/{kind}/{{episode}}.npz"
    camera = ["--allow_moving", "true", "--camera.poses", file, "--priors.masks", file, "--workers", "1"]
    change = ["--perturbation.type", "poses", "--perturbation.poses", json.dumps([pose]), "--max_unseen", "1"]
    return [*source, *camera, *change, *FAST, *more]


def unseen(out: Path) -> float:
    """Share of the new view that is uncovered."""
    views = json.loads(pq.read_table(out / "meta" / "msdyn" / "episodes.parquet").to_pylist()[-1]["gate"])["views"]
    return float(views[FRONT]["scores"]["unseen"])


def videos(out: Path) -> dict[Path, bytes]:
    """The files of all videos."""
    found = {path.relative_to(out): path.read_bytes() for path in (out / "videos").rglob("*.mp4")}
    assert found
    return found


def settings(walks: Path, kind: str) -> Recipe:
    recipe = Recipe()
    recipe.camera.poses, recipe.priors.cache = f"{walks}/{kind}/{{episode}}.npz", "off"
    return recipe


def test_each_episode_that_shares_the_world_shows_what_it_has(walks: Path) -> None:
    source = open_source("local/walks", walks / "walks")
    found = seen_together(source, [FRONT], settings(walks, "shared"))[FRONT]
    assert [shown.episode for shown in found if isinstance(shown, backgrounds.Shown)] == [0, 1]
    assert seen_together(source, [FRONT], settings(walks, "own")) == {FRONT: []}


def test_an_episode_without_poses_is_left_out(walks: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    shutil.copytree(walks / "shared", tmp_path / "shared")
    (tmp_path / "shared" / "1.npz").unlink()
    source, recipe = open_source("local/walks", walks / "walks"), settings(tmp_path, "shared")
    (found,) = seen_together(source, [FRONT], recipe)[FRONT]
    assert isinstance(found, backgrounds.Shown)
    assert found.episode == 0
    assert "episode 1 is left out" in caplog.text


@pytest.fixture(scope="module")
def alone(walks: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output where nothing is shared."""
    out = tmp_path_factory.mktemp("alone") / "new"
    assert run(*command(walks, out, "--scene.shared_background", "false")) == 0
    return out


def test_more_of_a_new_view_is_covered_by_two_recordings(
    walks: Path, alone: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    def unwanted(*_: object) -> None:
        raise AssertionError("it has been looked at")

    with monkeypatch.context() as first:
        first.setattr(job, "augment_episode", stopped)
        assert run(*command(walks, tmp_path / "new")) == 130
    monkeypatch.setattr(backgrounds, "shown_in_episode", unwanted)  # a run that goes on looks at no episode again
    assert run(*command(walks, tmp_path / "new")) == 0
    assert unseen(tmp_path / "new") < 0.7 * unseen(alone)


def test_poses_in_worlds_of_their_own_change_nothing(walks: Path, alone: Path, tmp_path: Path) -> None:
    assert run(*command(walks, tmp_path / "own", kind="own")) == 0
    assert unseen(tmp_path / "own") == unseen(alone)
    assert videos(tmp_path / "own") == videos(alone)


@pytest.mark.slow
def test_several_processes_share_the_same(walks: Path, tmp_path: Path) -> None:
    for out, workers in (("one", "1"), ("two", "2")):
        assert run(*command(walks, tmp_path / out, "--episodes", "[0, 1]", "--workers", workers)) == 0
    assert videos(tmp_path / "one") == videos(tmp_path / "two")
