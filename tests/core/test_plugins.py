"""Modules that `--plugins` names."""

import random
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from lerobot_msdyn.core import plugins
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.core.plugins import import_plugins, imported_plugins, plugin_digests


@pytest.fixture(autouse=True)
def _forgotten_afterwards(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What a test imports is not imported for the next, nor what other tests have imported for this one."""
    for name in [name for name in sys.modules if name.startswith(plugins.PREFIX)]:
        monkeypatch.delitem(sys.modules, name)
    before = set(sys.modules)
    monkeypatch.setattr(plugins, "_imported", {})
    yield
    for name in set(sys.modules) - before:
        del sys.modules[name]


def test_a_file_named_like_another_module_does_not_stand_before_it(tmp_path: Path) -> None:
    path = tmp_path / "random.py"
    path.write_text("class Mine: ...\n")
    import_plugins([str(path)])
    assert sys.modules["random"] is random
    (name,) = [name for name in sys.modules if name.startswith(plugins.PREFIX)]
    assert sys.modules[name].Mine.__module__ == name
    assert imported_plugins() == [str(path)]


def test_a_file_is_imported_once_however_it_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine.py").write_text("with open('times', 'a') as file: file.write('x')\n")
    monkeypatch.chdir(tmp_path)
    import_plugins(["mine.py", "./mine.py", str(tmp_path / "mine.py")])
    assert (tmp_path / "times").read_text() == "x"
    import_plugins(imported_plugins())
    assert (tmp_path / "times").read_text() == "x"


def test_a_package_is_named_by_its_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "plugin_of_this_test"
    package.mkdir()
    (package / "__init__.py").write_text("from . import part\n")
    (package / "part.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    import_plugins(["plugin_of_this_test"])
    before = plugin_digests()
    (package / "part.py").write_text("changed = True\n")
    assert before.keys() == plugin_digests().keys() == {"plugin_of_this_test"}
    assert before != plugin_digests()


@pytest.mark.parametrize(
    ("code", "message"),
    [
        (None, "there is no file .*mine.py"),
        ("1 / 0", "mine.py cannot be imported .ZeroDivisionError: division by zero"),
        ("import sys; sys.exit(3)", "mine.py cannot be imported .SystemExit: 3"),
        ("def f(:", "mine.py cannot be imported .SyntaxError"),
    ],
)
def test_what_cannot_be_imported_is_one_line(tmp_path: Path, code: str | None, message: str) -> None:
    path = tmp_path / "mine.py"
    if code is not None:
        path.write_text(code)
    with pytest.raises(ConfigError, match=message) as caught:
        import_plugins([str(path)])
    assert str(caught.value).startswith("--plugins: ")
    assert "\n" not in str(caught.value)
    assert imported_plugins() == []
    assert not any(name.startswith(plugins.PREFIX) for name in sys.modules)


def test_a_module_that_is_absent_and_a_folder_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="no_such_plugin cannot be imported"):
        import_plugins(["no_such_plugin"])
    (tmp_path / "folder_of_this_test").mkdir()
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError, match=r"folder_of_this_test is a folder without an __init__\.py"):
        import_plugins(["folder_of_this_test"])
