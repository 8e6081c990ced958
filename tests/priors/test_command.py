"""`python -m lerobot_msdyn.priors`, end to end."""

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from lerobot_msdyn.core.cli import run_command
from lerobot_msdyn.priors.__main__ import run as priors_command
from lerobot_msdyn.priors.exchange import read_exchange

FRONT, SIDE = "observation.images.front", "observation.images.side"


def run(*arguments: str) -> int:
    """The exit code of the command."""
    with pytest.raises(SystemExit) as caught:
        run_command(priors_command, [*arguments])
    assert isinstance(caught.value.code, int)
    return caught.value.code


def test_files_and_a_sheet_per_episode(desk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert run("--repo", "local/desk", "--root", str(desk), "--episodes", "1", "--out", str(out), "--columns", "3") == 0
    assert sorted(path.relative_to(out).as_posix() for path in out.rglob("*.*")) == [
        "episode_000001.png",
        f"episode_000001/{FRONT}.npz",
        f"episode_000001/{SIDE}.npz",
    ]
    found = read_exchange(out / "episode_000001" / f"{FRONT}.npz", 12, 48, 64, 1, FRONT)
    assert found.depth is not None
    assert found.depth_kind == "metric"
    assert found.provenance["depth"]["provider"] == "recorded"
    assert found.K is not None
    assert found.w2c is not None
    sheet = cv2.imread(str(out / "episode_000001.png"))
    assert sheet is not None
    assert sheet.shape[1] == 3 * 324
    assert len(np.unique(sheet.reshape(-1, 3), axis=0)) > 100
    assert f"{FRONT}.npz  12 frames in" in capsys.readouterr().out


def test_its_files_can_be_given_back(desk: Path, tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    arguments = ["--repo", "local/desk", "--root", str(desk), "--episodes", "[0]", "--cameras", "[front]", "--out"]
    assert run(*arguments, str(first)) == 0
    pattern = str(first / "episode_{episode:06d}" / "{camera}.npz")
    given = [f"--priors.{prior}={pattern}" for prior in ("depth", "masks", "tracks")]
    assert run(*arguments, str(second), *given, f"--camera.poses={pattern}") == 0
    old, new = (
        read_exchange(folder / "episode_000000" / f"{FRONT}.npz", 12, 48, 64, 0, FRONT) for folder in (first, second)
    )
    for name in ("masks", "tracks", "vis", "conf", "K", "w2c"):
        np.testing.assert_allclose(getattr(new, name), getattr(old, name), atol=1e-5)
    assert new.provenance["tracks"]["provider"] == "file"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "--repo is missing"),
        (["--repo", "local/desk"], "--out is missing"),
        (["--priors.masks", "sam3"], "priors.masks is 'sam3'; expected auto, change, edgetam, onnx, sam2 or a file"),
        (
            ["--priors.depth", "lidar"],
            "priors.depth is 'lidar'; expected auto, depth_anything, ",
        ),
        (["--priors.tracks", "tapir"], "priors.tracks is 'tapir'; expected auto, flow, raft or a file FILE.npz"),
        (["--camera.poses", "slam"], "camera.poses is 'slam'; expected auto, fixed, sfm or a file FILE.npz"),
    ],
)
def test_bad_input_is_one_line(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(*arguments) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1
    assert said[0].startswith(f"error: {message}")


def test_a_file_of_another_episode_is_refused(desk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--repo", "local/desk", "--root", str(desk), "--cameras", "[front]", "--out", str(tmp_path)]
    assert run(*arguments, "--episodes", "0") == 0
    file = tmp_path / "episode_000000" / f"{FRONT}.npz"
    assert run(*arguments, "--episodes", "1", "--priors.masks", str(file)) == 2
    assert "is of episode 0, not 1: it belongs to another video" in capsys.readouterr().err


def test_help_answers_without_importing_torch() -> None:
    code = (
        "import sys\nfrom lerobot_msdyn.priors.__main__ import run\n"
        "try: run(['--help'])\n"
        "except SystemExit: pass\n"
        "assert 'torch' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "--priors.masks" in done.stdout
