"""What importing the package and running its commands does to the process."""

import importlib
import json
import subprocess
import sys
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from lerobot_msdyn.augment import asked as asked_of_augment
from lerobot_msdyn.augment.__main__ import run as augment
from lerobot_msdyn.core.cli import run_command
from lerobot_msdyn.core.errors import MsdynError
from lerobot_msdyn.dataset import metadata
from lerobot_msdyn.evaluate import asked as asked_of_evaluate

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


K = [[50, 0, 32], [0, 50, 24], [0, 0, 1]]
DESK = "--repo local/desk --root {desk}"
FROM_TOP = "--perturbation.type other_camera --perturbation.camera top"
NO_TOP = "local/desk: no colour camera 'top'; it has observation.images.front, observation.images.side"
NO_EPISODE = "local/desk: no episode 999; it has 3 (0 to 2)"
NO_SCENES = "no saved scenes in {tmp}/absent: expected msdyn_scenes/episode_000000/<camera>/scene.json"
NO_CALIBRATION = "{tmp}/absent.json: calibration cannot be read ([Errno 2] No such file"
NO_ROBOT = "robot.name is 'nosuch'; expected so101, so100, g1, a name of the package robot_descriptions"
OLD = "{tmp}/old is a LeRobot dataset of version v2.1; expected v3.0; add --convert"
HELDOUT = f"heldout-camera {DESK} --calibration {{tmp}}/calibration.json --out {{tmp}}/out"
NAMED = [  # command, arguments, how the answer begins
    ("augment.__main__", f"{DESK} --cameras [top]", NO_TOP),
    ("augment.__main__", f"{DESK} --episodes [0,999]", NO_EPISODE),
    ("augment.__main__", "--repo local/old --root {tmp}/old", OLD),
    ("augment.__main__", f"{DESK} --robot.name nosuch", NO_ROBOT),
    (
        "augment.__main__",
        f"{DESK} --robot.urdf {{tmp}}/absent.urdf",
        "{tmp}/absent.urdf: the robot's description",
    ),
    ("augment.__main__", f"{DESK} --scenes {{tmp}}/absent", NO_SCENES),
    ("augment.__main__", f"{DESK} --camera.calibration {{tmp}}/absent.json", NO_CALIBRATION),
    (
        "augment.__main__",
        f"{DESK} --camera.calibration {{tmp}}/calibration.json {FROM_TOP}",
        "perturbation.camera is 'top', which the calibration {tmp}/calibration.json does not name",
    ),
    (
        "augment.__main__",
        f'{DESK} --camera.pose_columns {{{{"top":action}}}}',
        "camera.pose_columns names the camera 'top'; local/desk has observation.images.front, observation.images.side",
    ),
    *([("cluster.__main__", f"{DESK} --cameras [top]", NO_TOP)] if find_spec("datatrove") else []),
    ("priors.__main__", f"{DESK} --out {{tmp}}/out --cameras [top]", NO_TOP),
    ("priors.__main__", f"{DESK} --out {{tmp}}/out --episodes 999", NO_EPISODE),
    ("priors.__main__", f"{DESK} --out {{tmp}}/out --camera.calibration {{tmp}}/absent.json", NO_CALIBRATION),
    (
        "priors.__main__",
        f"{DESK} --out {{tmp}}/out --priors.depth {{tmp}}/absent.npz",
        "{tmp}/absent.npz: not a readable npz file of plain arrays (FileNotFoundError: ",
    ),
    ("viewer", f"{DESK} --cameras [top]", NO_TOP),
    ("viewer", f"{DESK} --episode 999", NO_EPISODE),
    ("viewer", f"{DESK} --scenes {{tmp}}/absent", NO_SCENES),
    ("viewer", f"{DESK} --scenes {{tmp}}/kept --episode 1", "{tmp}/kept: no saved scene of episode 1 of local/desk"),
    (
        "viewer",
        f"{DESK} {FROM_TOP}",
        "perturbation 'other_camera' needs the pose of camera 'top', which is not kept with saved scenes",
    ),
    ("calibrate", f"{DESK} --robot.name nosuch --cameras [top]", NO_TOP),
    ("calibrate", f"{DESK} --robot.name nosuch --episodes 999", NO_EPISODE),
    ("calibrate", f"{DESK} --robot.name nosuch", NO_ROBOT),
    ("evaluate.__main__", f"{HELDOUT} --train-camera top --test-camera side", NO_TOP),
    ("evaluate.__main__", f"{HELDOUT} --train-camera front --test-camera top", NO_TOP),
    ("evaluate.__main__", f"{HELDOUT} --train-camera front --test-camera side --episode 999", NO_EPISODE),
    (
        "evaluate.__main__",
        "nvs --scene {tmp}/absent --out {tmp}/out",
        "{tmp}/absent/gt/train.npz: expected an npz file with K, c2w ([Errno 2] No such file or directory",
    ),
    (
        "evaluate.__main__",
        "dycheck --root {tmp}/absent --out {tmp}/out",
        "{tmp}/absent/splits/train.json: cannot be read ([Errno 2] No such file or directory",
    ),
    ("evaluate.__main__", "nvs --scene {tmp}/scene --out {tmp}/out --cameras [top]", NO_TOP.replace("desk", "scene")),
    ("evaluate.__main__", "nvs --scene {tmp}/scene --out {tmp}/out --robot.name nosuch", NO_ROBOT),
    ("export_ply", "--scenes {tmp}/absent", NO_SCENES),
    ("export_ply", "--scenes {tmp}/kept --episode 1", "{tmp}/kept: no scene of episode 1; there are those of 0"),
    ("export_ply", "--scenes {tmp}/kept --camera top", "{tmp}/kept: no scene of camera 'top'; there are front"),
    ("split", "--root {tmp}/old", OLD),
    ("carry", "--root {desk} --sources [{tmp}/old]", OLD),
]


@pytest.fixture
def places(desk: Path, tmp_path: Path) -> dict[str, Path]:
    """A dataset, and a folder with a calibration, a dataset of another version, a kept scene and one to evaluate."""
    (tmp_path / "old" / "meta").mkdir(parents=True)
    info = json.loads((desk / "meta" / "info.json").read_text())
    (tmp_path / "old" / "meta" / "info.json").write_text(json.dumps(info | {"codebase_version": "v2.1"}))
    (tmp_path / "calibration.json").write_text(json.dumps({"cameras": {"front": {"K": K}, "side": {"K": K}}}))
    (tmp_path / "kept" / "episode_000000" / "front").mkdir(parents=True)
    (tmp_path / "kept" / "episode_000000" / "front" / "scene.json").touch()
    (tmp_path / "scene" / "gt").mkdir(parents=True)
    (tmp_path / "scene" / "dataset_depth").symlink_to(desk)
    np.savez(tmp_path / "scene" / "gt" / "train.npz", K=np.array(K), c2w=np.eye(4)[None])
    return {"desk": desk, "tmp": tmp_path}


def test_names_of_what_is_not_there_are_answered_before_anything_slow_is_imported(places: dict[str, Path]) -> None:
    calls = [(command, text.format(**places).split(" ")) for command, text, _ in NAMED]
    code = f"""
import importlib
from lerobot_msdyn.core.cli import run_command
sys.stderr = sys.stdout
for command, arguments in {calls}:
    try: run_command(importlib.import_module("lerobot_msdyn." + command).run, arguments)
    except SystemExit as end: print(end.code, end=" ")
    print(sorted({{"torch", "lerobot", "transformers", "kornia", "pandas", "cv2", "numba"}} & set(sys.modules)))
"""
    lines = in_a_new_process(code).splitlines()
    assert len(lines) == 2 * len(NAMED), lines
    for (command, _, begins), said, end in zip(NAMED, lines[::2], lines[1::2], strict=True):
        assert said.startswith(f"error: {begins.format(**places)}"), (command, said)
        assert end == "2 []", (command, said, end)


@pytest.mark.parametrize(
    ("command", "text"),
    [
        (command, text)
        for command, text, begins in NAMED
        if begins in (NO_TOP, NO_EPISODE, NO_ROBOT, OLD) and command not in ("cluster.__main__", "split", "carry")
    ],
)
def test_lerobot_is_asked_as_well_and_the_answer_is_the_same(
    command: str, text: str, places: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As it is where the dataset comes from the hub."""
    run = importlib.import_module(f"lerobot_msdyn.{command}").run
    arguments = text.format(**places).split(" ")
    arguments += ["--new_root", f"{places['tmp']}/new"] if command.startswith("augment") else []
    if command == "viewer":
        pytest.importorskip("rerun")
        arguments += ["--save", f"{places['tmp']}/a.rrd"]
    asked: list[str] = []
    with pytest.raises(MsdynError) as early:
        run(arguments)
    for module in (metadata, asked_of_augment, asked_of_evaluate):
        monkeypatch.setattr(module, "described", lambda repo_id, root: asked.append(repo_id))
    with pytest.raises(MsdynError) as late:
        run(arguments)
    assert (type(late.value), str(late.value)) == (type(early.value), str(early.value))
    assert len(asked) == 1


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
