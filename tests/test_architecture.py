"""The structure that docs/architecture.md shows is the structure that the code has."""

import ast
import re
from pathlib import Path

import lerobot_msdyn

PACKAGE = Path(lerobot_msdyn.__file__).parent
PROJECT = Path(__file__).parent.parent
# Library -> where it may be imported: a folder or root file, or a folder/file.
ONLY_IN = {
    "gsplat": {"render"},
    "rerun": {"viewer"},
    "flip_evaluator": {"evaluate"},
    "lpips": {"evaluate"},
    "onnxruntime": {"priors"},
    "datatrove": {"cluster"},
    "ray": {"cluster"},
    "fsspec": {"cluster"},
    "lerobot": {"dataset", "augment", "cluster", "training", "evaluate", "synthetic/dataset", "split", "carry"},
}


def documented_order() -> list[str]:
    text = (PROJECT / "docs" / "architecture.md").read_text()
    block = re.search(r"## The tree.*?```\n(.*?)```", text, re.DOTALL)
    assert block is not None
    return [line.split()[0] for line in block[1].splitlines()]


def imports() -> list[tuple[str, str, Path]]:
    """(module that imports, what it imports, file)."""
    pairs = []
    for path in PACKAGE.rglob("*.py"):
        here = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{path}: relative import"
                assert all(alias.name != "*" for alias in node.names), f"{path}: wildcard import"
                pairs.append((here, node.module or "", path))
            elif isinstance(node, ast.Import):
                pairs += [(here, alias.name, path) for alias in node.names]
    return pairs


def _file(path: Path) -> str:
    """A file as FOLDER/NAME."""
    return str(path.relative_to(PACKAGE).with_suffix(""))


def test_every_module_is_documented() -> None:
    there = {path.stem for path in PACKAGE.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert sorted(documented_order()) == sorted(there - {"__init__"})


def test_imports_point_one_way() -> None:
    order = documented_order()
    wrong = []
    for here, module, path in imports():
        if not module.startswith("lerobot_msdyn.") or here == "__init__":
            continue
        there = module.split(".")[1]
        if there != here and order.index(there) >= order.index(here):
            wrong.append(f"{path.relative_to(PACKAGE)} imports {module}")
    assert wrong == []


def test_outside_libraries_are_imported_where_documented() -> None:
    wrong = [
        f"{path.relative_to(PACKAGE)} imports {module}"
        for here, module, path in imports()
        if not ({here, _file(path)} & ONLY_IN.get(module.split(".")[0], {here}))
    ]
    assert wrong == []


def test_library_neither_prints_nor_evaluates() -> None:
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                assert node.func.id not in ("print", "eval", "exec", "breakpoint"), f"{path}:{node.lineno}"
