"""A name of no dataset is answered at once, before LeRobot is imported."""

import subprocess
import sys
from pathlib import Path

import pytest
from huggingface_hub import HfApi
from lerobot.utils.constants import HF_LEROBOT_HOME

from lerobot_msdyn.core.errors import DatasetError
from lerobot_msdyn.dataset import read
from lerobot_msdyn.dataset.named import check_named, lerobot_home, output_folder
from lerobot_msdyn.dataset.read import open_source


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """LeRobot's home with one dataset, and a hub that cannot be reached."""
    (tmp_path / "local" / "desk" / "meta").mkdir(parents=True)
    (tmp_path / "local" / "desk" / "meta" / "info.json").write_text("{}")
    monkeypatch.setenv("HF_LEROBOT_HOME", str(tmp_path))

    def unreachable(self: object, repo_id: str, timeout: float) -> None:
        raise ConnectionError

    monkeypatch.setattr(HfApi, "dataset_info", unreachable)
    return tmp_path


def test_home_is_that_of_lerobot() -> None:
    assert lerobot_home() == HF_LEROBOT_HOME


def test_an_output_is_found_by_its_name(home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "here").mkdir()
    for place, found in (("here", "here"), ("local/desk", "local/desk"), ("local/none", "local/none")):
        assert output_folder(Path(place)) == Path(found)
    monkeypatch.chdir(tmp_path / "here")
    assert output_folder(Path("local/desk")) == home / "local" / "desk"
    assert output_folder(home / "here") == home / "here"
    assert output_folder(Path("local/none")) == Path("local/none")


def test_the_nearest_name_is_told(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(read, "LeRobotDatasetMetadata", lambda repo_id: pytest.fail("LeRobot was asked"))
    for refuses in (check_named, open_source):
        with pytest.raises(DatasetError, match=r"ConnectionError\); did you mean 'local/desk'\? Else give its folder"):
            refuses("local/dsk")
    with pytest.raises(DatasetError, match=r"if it lies elsewhere, give its folder with --root"):
        check_named("someone/else")


def test_what_is_there_or_was_downloaded_needs_no_hub(home: Path) -> None:
    check_named("local/desk")
    (home / "hub" / "datasets--lerobot--pusht").mkdir(parents=True)
    check_named("lerobot/pusht")


def test_the_command_answers_without_torch(tmp_path: Path) -> None:
    code = (
        "import sys; from lerobot_msdyn.augment.__main__ import run\n"
        "from lerobot_msdyn.core.errors import DatasetError\n"
        "try: run(['--repo', 'local/dsk'])\n"
        "except DatasetError as error: print(error)\n"
        "print('torch' in sys.modules)"
    )
    environment = {"HF_LEROBOT_HOME": str(tmp_path), "HF_HUB_OFFLINE": "1", "PATH": ""}
    said = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert said.stdout.startswith("no dataset 'local/dsk'")
    assert said.stdout.endswith("False\n")
