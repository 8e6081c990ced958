"""What `pip install` installs."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

PROJECT = Path(__file__).parent.parent


@pytest.mark.slow
def test_recipes_are_in_the_wheel_and_found_by_name(tmp_path: Path) -> None:
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path), str(PROJECT)]
    subprocess.run(build, check=True, capture_output=True)
    wheel = next(tmp_path.glob("*.whl"))
    with zipfile.ZipFile(wheel) as file:
        names = file.namelist()
        file.extractall(tmp_path / "installed")
    assert "lerobot_msdyn/recipes/quick.yaml" in names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert not any(name.startswith(("tests/", "examples/", "recipes/")) for name in names)
    code = "from lerobot_msdyn.cli import *; print(recipe_folder(), load_recipe('quick').variants)"
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env={"PYTHONPATH": str(tmp_path / "installed")},
        cwd=tmp_path,
    )
    assert done.stdout.split() == [str(tmp_path / "installed" / "lerobot_msdyn" / "recipes"), "1"]
