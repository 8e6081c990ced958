"""Implementations by name: built-in files, entry points, and what is said when one is wrong."""

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from lerobot_msdyn.core import registry as registry_module
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.core.registry import Registry, extending_packages

FOLDER = "kinds_of_this_test"


@pytest.fixture
def shapes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Registry]:
    """A registry whose folder has one good file, one that registers nothing, and one that fails."""
    folder = tmp_path / "site" / FOLDER
    folder.mkdir(parents=True)
    (folder / "__init__.py").write_text(
        f"from lerobot_msdyn.core.registry import Registry\nSHAPES = Registry('shape', {FOLDER!r})\n"
    )
    good = f"from {FOLDER} import SHAPES\n@SHAPES.register('square')\nclass Square: ...\n"
    (folder / "square.py").write_text(good)
    (folder / "silent.py").write_text(good.replace("'square'", "'triangle'"))
    (folder / "broken.py").write_text("import no_such_module\n")
    (folder / "_helper.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path / "site")
    registry_module._all_entry_points.cache_clear()
    yield importlib.import_module(FOLDER).SHAPES
    registry_module._all_entry_points.cache_clear()
    for name in [name for name in sys.modules if name.split(".")[0] in (FOLDER, "circles", "more_circles")]:
        del sys.modules[name]


def install(tmp_path: Path, name: str, code: str, entry_point: str, group: str = FOLDER) -> None:
    """A package as pip would leave it, with one entry point."""
    site = tmp_path / "site"
    (site / f"{name}.py").write_text(code)
    info = site / f"{name}-1.2.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.2\n")
    (info / "entry_points.txt").write_text(f"[{group}]\n{entry_point}\n")
    registry_module._all_entry_points.cache_clear()


def test_files_are_named_without_importing_them(shapes: Registry) -> None:
    assert shapes.names() == ["broken", "silent", "square"]
    assert "square" in shapes
    assert "_helper" not in shapes
    assert f"{FOLDER}.square" not in sys.modules
    square = shapes.get("square")
    assert square.__name__ == "Square"
    assert shapes.name_of(square) == "square"
    with pytest.raises(ValueError, match="is no registered shape"):
        shapes.name_of(int)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("circle", "no shape 'circle'; expected one of broken, silent, square"),
        ("broken", f"shape 'broken': {FOLDER}.broken cannot be imported .ModuleNotFoundError: .*no_such_module"),
        ("silent", f"shape 'silent': {FOLDER}.silent registers nothing under this name"),
    ],
)
def test_what_cannot_be_had_is_named(shapes: Registry, name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        shapes.get(name)
    assert "\n" not in str(caught.value)


def test_another_package_s_entry_point_is_found(shapes: Registry, tmp_path: Path) -> None:
    install(tmp_path, "circles", "class Circle: ...\n", "circle = circles:Circle")
    assert "circle" in shapes.names()
    assert "circles" not in sys.modules
    assert shapes.get("circle").__name__ == "Circle"


def test_an_entry_point_may_be_a_module_that_registers_itself(shapes: Registry, tmp_path: Path) -> None:
    code = f"from {FOLDER} import SHAPES\n@SHAPES.register('circle')\nclass Circle: ...\n"
    install(tmp_path, "circles", code, "circle = circles")
    assert shapes.get("circle").__name__ == "Circle"
    install(tmp_path, "more_circles", "", "ellipse = more_circles")
    with pytest.raises(ConfigError, match="shape 'ellipse': more_circles registers nothing under this name"):
        shapes.get("ellipse")


def test_an_entry_point_that_fails_is_named_when_it_is_asked_for(shapes: Registry, tmp_path: Path) -> None:
    install(tmp_path, "circles", "1 / 0\n", "circle = circles:Circle")
    assert shapes.get("square").__name__ == "Square"
    with pytest.raises(ConfigError, match=r"shape 'circle': circles:Circle cannot be imported \(ZeroDivisionError"):
        shapes.get("circle")


def test_a_name_belongs_to_one(shapes: Registry, tmp_path: Path) -> None:
    class Mine: ...

    with pytest.raises(ConfigError, match=f"'square' is registered twice: by {FOLDER}.square and by .*Mine of .*py"):
        shapes.register("square")(Mine)
    shapes.get("square")
    with pytest.raises(ConfigError, match=r"'square' is registered twice: by Square of .*square\.py and by .*Mine of"):
        shapes.add("square", Mine)
    install(tmp_path, "circles", "class Circle: ...\n", "circle = circles:Circle")
    install(tmp_path, "more_circles", "class Circle: ...\n", "circle = more_circles:Circle")
    with pytest.raises(ConfigError, match="'circle' is registered twice: by circles:Circle and by more_circles:Circle"):
        shapes.get("circle")


def test_an_entry_point_does_not_replace_a_file(shapes: Registry, tmp_path: Path) -> None:
    install(tmp_path, "circles", "class Circle: ...\n", "square = circles:Circle")
    with pytest.raises(ConfigError, match=f"'square' is registered twice: by {FOLDER}.square and by circles:Circle"):
        shapes.get("square")


def test_a_module_that_is_run_again_registers_again(shapes: Registry) -> None:
    first = shapes.get("square")
    importlib.reload(sys.modules[f"{FOLDER}.square"])
    assert shapes.get("square") is not first


def test_names_are_those_that_a_recipe_can_hold(shapes: Registry) -> None:
    with pytest.raises(ConfigError, match=r"shape 'my\.npz': expected a name of letters, digits and underscores"):
        shapes.add("my.npz", int)


def test_packages_that_extend_this_one_are_told_by_version(shapes: Registry, tmp_path: Path) -> None:
    install(tmp_path, "circles", "", "circle = circles", group="lerobot_msdyn.priors.depth.providers")
    assert extending_packages()["circles"] == "1.2"
