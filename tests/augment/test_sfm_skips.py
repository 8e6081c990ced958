"""Structure from motion that fails on one episode costs that episode alone."""

from pathlib import Path

import pytest
from augment_command import FAST, run
from walking import walk

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.errors import EpisodeError
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.dataset.provenance import read_provenance
from lerobot_msdyn.priors import estimate
from lerobot_msdyn.priors.camera.providers import sfm
from lerobot_msdyn.synthetic.dataset import write_dataset


def test_the_others_are_made_and_it_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, view, _ = walk()
    write_dataset([scene, scene], "local/walk", tmp_path / "walk", depth=True)
    asked = 0

    def first_fails(seen: View, *_: object) -> CameraTrack:
        nonlocal asked
        asked += 1
        if asked == 1:
            raise EpisodeError("structure from motion registered 3 of 12 frames")
        return view.camera.resized(seen.camera.width, seen.camera.height)

    monkeypatch.setattr(sfm, "camera_from_sfm", first_fails)
    monkeypatch.setattr(estimate, "scaled_to_depth", lambda camera, *_: (camera, 1.0))
    source = ["--repo", "local/walk", "--root", str(tmp_path / "walk"), "--new_root", str(tmp_path / "new")]
    flags = ["--allow_moving", "true", "--camera.poses", "sfm", "--variants", "1", "--workers", "1"]
    once = ["--gate.enabled", "false", "--scene.shared_background", "false"]
    assert run(*source, *flags, *once, *FAST) == 1
    said = capsys.readouterr().err
    assert "local/walk episode 0, observation.images.front: structure from motion registered 3 of 12 frames" in said
    assert {row["source_episode"] for row in read_provenance(tmp_path / "new") or []} == {1}
