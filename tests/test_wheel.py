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
    assert "lerobot_msdyn/recipe_files/quick.yaml" in names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert not any(name.startswith(("tests/", "examples/", "recipes/")) for name in names)

    def said(*arguments: str) -> str:
        path = {"PYTHONPATH": str(tmp_path / "installed")}
        command = [sys.executable, *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, env=path, cwd=tmp_path).stdout

    listed = [line.split()[0] for line in said("-m", "lerobot_msdyn.recipes", "ls").splitlines()]
    assert listed == sorted(path.stem for path in (PROJECT / "recipes").glob("*.yaml"))
    code = (
        "from lerobot_msdyn.core.cli import load_recipe; from lerobot_msdyn.core.recipe_files import recipe_folder; "
        "print(recipe_folder(), load_recipe('quick').variants)"
    )
    assert said("-c", code).split() == [str(tmp_path / "installed" / "lerobot_msdyn" / "recipe_files"), "1"]
