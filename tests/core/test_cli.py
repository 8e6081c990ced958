"""What importing the package and running its commands does to the process."""

import subprocess
import sys
from importlib.metadata import version

import pytest

from lerobot_msdyn.augment.__main__ import run as augment
from lerobot_msdyn.core.cli import run_command

COMMANDS = ["augment", "evaluate", "priors", "split", "carry", "recipes", "viewer", "export_ply", "__main__"]
HOMES = {"augment": "augment.__main__", "evaluate": "evaluate.__main__", "priors": "priors.__main__"}


def in_a_new_process(code: str) -> str:
    """What a program prints that begins without any setting for OpenMP."""
    begin = "import os, sys; os.environ.pop('OMP_WAIT_POLICY', None)\n"
    done = subprocess.run([sys.executable, "-c", begin + code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_makes_idle_threads_wait_before_torch_is_loaded(command: str) -> None:
    code = f"""
sys.argv = ["{command}", "--help"]
import lerobot_msdyn.{HOMES.get(command, command)} as command
assert "OMP_WAIT_POLICY" not in os.environ
assert "torch" not in sys.modules
try: command.main()
except SystemExit as end: assert end.code in (0, None), end.code
assert "torch" not in sys.modules
sys.stderr.write(os.environ["OMP_WAIT_POLICY"] + "\\n")
"""
    assert in_a_new_process(code.replace("sys.stderr", "sys.stdout")).endswith("PASSIVE\n")


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        ("augment.__main__", ["--varants", "2"]),
        ("augment.__main__", ["--repo", "local/absent"]),
        ("augment.__main__", ["--repo", "local/absent", "--root", "absent"]),
        ("cluster.__main__", ["--repo", "local/absent"]),
        ("priors.__main__", ["--repo", "local/absent", "--out", "out"]),
        ("viewer", ["--repo", "local/absent"]),
        ("calibrate", ["--repo", "local/absent"]),
        ("split", ["--repo", "local/absent"]),
        ("carry", ["--root", "absent", "--sources", "[absent]"]),
    ],
)
def test_what_is_mistyped_is_answered_before_anything_slow_is_imported(command: str, arguments: list[str]) -> None:
    code = f"""
import lerobot_msdyn.{command} as command
sys.argv = ["command", *{arguments}]
try: command.main()
except SystemExit as end: assert end.code == 2, end.code
print(sorted({{"torch", "lerobot", "cv2", "numba"}} & set(sys.modules)))
"""
    assert in_a_new_process(code) == "[]\n"


def test_a_command_leaves_the_user_s_own_setting() -> None:
    code = """
os.environ["OMP_WAIT_POLICY"] = "ACTIVE"
from lerobot_msdyn.recipes import main
sys.argv = ["recipes", "--help"]
try: main()
except SystemExit: pass
print(os.environ["OMP_WAIT_POLICY"])
"""
    assert in_a_new_process(code).endswith("ACTIVE\n")


def test_the_version_is_the_installed_one(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        run_command(augment, ["--version"])
    assert end.value.code == 0
    assert capsys.readouterr().out == f"lerobot_msdyn {version('lerobot_msdyn')}\n"


@pytest.mark.slow
def test_importing_any_module_changes_no_setting_of_the_process() -> None:
    """Of the environment, logging, temporary files, threads and warnings, beyond what the libraries do themselves."""
    code = """
import importlib, logging, pathlib, tempfile, warnings
import av, cv2, torch, kornia, numba, tqdm, draccus, lerobot.datasets, lerobot.scripts.convert_dataset_v21_to_v30
def settings():
    root, loggers = logging.root, logging.root.manager.loggerDict.values()
    levels = {each.name: each.level for each in loggers if isinstance(each, logging.Logger) and each.level}
    return (dict(os.environ), tempfile.tempdir, root.level, root.handlers[:], root.manager.disable,
            levels, torch.get_num_threads(), cv2.getNumThreads(), torch.is_grad_enabled(), torch.get_default_dtype(),
            warnings.filters[:], os.getcwd(), sys.path[:], av.logging.get_level())
before = settings()
import lerobot_msdyn
root, imported = pathlib.Path(lerobot_msdyn.__file__).parent, 0
for path in sorted(root.rglob("*.py")):
    parts = path.relative_to(root.parent).with_suffix("").parts
    if "plugin" in parts:  # for a training script that is running
        continue
    try: importlib.import_module(".".join(parts).removesuffix(".__init__"))
    except ImportError as error: assert "lerobot_msdyn" not in str(error), path  # an extra that is not installed
    else: imported += 1
after = settings()
assert imported > 100, imported
for old, new in zip(before, after, strict=True):
    assert old == new, (old, new)
print("unchanged")
"""
    assert in_a_new_process(code).endswith("unchanged\n")
