"""The command line, end to end: what a user types, what comes out, and what is refused."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from augment_command import FAST, FRONT, SIDE, run
from lerobot.datasets import LeRobotDataset

from lerobot_msdyn.augment import run as job
from lerobot_msdyn.augment import workers

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def augmented(desk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Episodes 0 and 2, front camera, two variants each."""
    out = tmp_path_factory.mktemp("augmented") / "new"
    arguments = ["--repo", "local/desk", "--root", str(desk), "--new_root", str(out), "--episodes", "[2,0]"]
    assert run(*arguments, "--cameras", "[front]", "--variants", "2", *FAST) == 0
    return out


def test_output_is_the_source_seen_from_elsewhere(desk: Path, augmented: Path) -> None:
    source = LeRobotDataset("local/desk", root=desk, video_backend="pyav")
    output = LeRobotDataset("local/desk_msdyn", root=augmented, video_backend="pyav")
    origin = [0, 0, 0, 2, 2, 2]
    assert output.num_episodes == 6
    position = 0
    for number, old in enumerate(origin):
        row = source.meta.episodes[old]
        changed = []
        for i in range(row["length"]):
            a, b = source[row["dataset_from_index"] + i], output[position]
            assert a.keys() == b.keys()
            for key in ("action", "observation.state", "timestamp", "frame_index", "task_index", SIDE, f"{SIDE}_depth"):
                assert torch.equal(a[key], b[key]), (number, i, key)
            assert a["task"] == b["task"]
            changed.append(float((a[FRONT] - b[FRONT]).abs().mean()))
            assert torch.equal(a[f"{FRONT}_depth"], b[f"{FRONT}_depth"]) == (number % 3 == 0), (number, i)
            measured = b[f"{FRONT}_depth"] > 15  # mm; missing pixels come back as 10
            assert measured.float().mean() > 0.5
            assert 300 < b[f"{FRONT}_depth"][measured].median() < 3000
            position += 1
        if number % 3 == 0:
            assert max(changed) == 0
        else:
            assert min(changed) > 0.01, "the view did not change"
            assert max(changed) < 0.3, "the view has nothing to do with the recorded one"


def test_variants_differ_and_episodes_say_where_they_come_from(augmented: Path) -> None:
    output = LeRobotDataset("local/desk_msdyn", root=augmented, video_backend="pyav")
    starts = output.meta.episodes["dataset_from_index"]
    assert not torch.equal(output[starts[1]][FRONT], output[starts[2]][FRONT])
    rows = pq.read_table(augmented / "meta" / "msdyn" / "episodes.parquet").to_pylist()
    assert [(row["source_episode"], row["variant"]) for row in rows] == [(e, v) for e in (0, 2) for v in (-1, 0, 1)]
    sampled = json.loads(rows[1]["perturbation"])[FRONT]
    assert abs(sampled["azimuth_deg"]) <= 15


def test_the_same_command_gives_the_same_pictures(desk: Path, augmented: Path, tmp_path: Path) -> None:
    arguments = ["--repo", "local/desk", "--root", str(desk), "--new_root", str(tmp_path / "new"), "--episodes", "[2]"]
    options = ["--cameras", "[front]", "--variants", "1", "--include_source", "false"]
    assert run(*arguments, *options, *FAST) == 0
    first = LeRobotDataset("local/desk_msdyn", root=augmented, video_backend="pyav")
    second = LeRobotDataset("local/desk_msdyn", root=tmp_path / "new", video_backend="pyav")
    assert second.num_episodes == 1
    start = first.meta.episodes[4]["dataset_from_index"]
    for i in range(len(second)):
        assert torch.equal(first[start + i][FRONT], second[i][FRONT])


def test_dry_run_writes_nothing(desk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--repo", "local/desk", "--root", str(desk), "--new_root", str(tmp_path / "new"), "--dry_run") == 0
    printed = capsys.readouterr().out
    assert "reads  3 episodes, 36 frames, of local/desk" in printed
    assert f"writes 9 episodes, 108 frames, to {tmp_path / 'new'}" in printed
    assert "for each that is read: the recorded one and 2 new; 144 new pictures" in printed
    assert re.search(r"time +[\d.]+ to [\d.]+ (seconds|minutes) on this machine by one process", printed)
    assert re.search(r"disk +\d+\.\d to \d+\.\d MB", printed)
    assert list(tmp_path.iterdir()) == []


def test_output_stands_beside_the_source_by_default(desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--repo", "local/desk", "--root", str(desk), "--dry_run") == 0
    assert f"to {desk.parent / 'desk_msdyn'}\n" in capsys.readouterr().out


def test_bad_input_is_one_line_and_exit_code_2(desk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "there").mkdir()
    old = tmp_path / "old"
    shutil.copytree(desk, old)
    info = old / "meta" / "info.json"
    info.write_text(json.dumps(json.loads(info.read_text()) | {"codebase_version": "v2.1"}))
    recipe = tmp_path / "mine.yaml"
    recipe.write_text("variantz: 3\n")
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text("variants: many\n")
    source = ["--repo", "local/desk", "--root", str(desk), "--new_root", str(tmp_path / "new")]
    cases = [
        ([], "which dataset?"),
        (["--repo", "local/absent", "--root", str(tmp_path / "absent")], "no dataset in"),
        (["--repo", "local/absent"], "no dataset 'local/absent'"),
        (["--repo", "local/desk", "--root", str(old)], "add --convert"),
        ([*source, "--cameras", "[top]"], "no colour camera 'top'; it has"),
        ([*source, "--episodes", "[7]"], "no episode 7; it has 3 (0 to 2)"),
        ([*source, "--new_root", str(tmp_path / "there")], "exists already"),
        ([*source, "--recipe", str(recipe)], "unknown field 'variantz', did you mean 'variants'?"),
        ([*source, "--recipe", str(wrong)], "Couldn't parse 'many' into an int"),
        ([*source, "--priors.depth", str(tmp_path / "no.npz")], "not a readable npz file"),
        ([*source, "--device", "cuda"], "--device cpu"),
    ]
    for arguments, message in cases:
        assert run(*arguments) == 2, arguments
        printed = capsys.readouterr().err
        errors = [line for line in printed.splitlines() if line.startswith("error: ")]
        assert len(errors) == 1, printed
        assert message in errors[0]
        assert "Traceback" not in printed
        assert not (tmp_path / "new").exists()
    assert not any(path.name.endswith(".partial") for path in tmp_path.iterdir())


def test_a_truncated_video_costs_its_episode_only(
    half_broken_desk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--repo", "local/desk", "--root", str(half_broken_desk), "--new_root", str(tmp_path / "new")]
    assert run(*arguments, "--variants", "1", *FAST) == 1
    printed = capsys.readouterr().out
    assert "1 of 2 episodes, 1 new ones" in printed
    assert "skipped: local/desk episode 1, observation.images.front" in printed
    output = LeRobotDataset("local/desk_msdyn", root=tmp_path / "new", video_backend="pyav")
    assert output.num_episodes == 2
    assert np.isfinite([float(output[i][FRONT].mean()) for i in range(len(output))]).all()
    before = content(tmp_path / "new")
    assert run(*arguments, "--variants", "1", *FAST) == 0
    printed = capsys.readouterr().out
    assert printed.startswith(f"finished before: written to {tmp_path / 'new'}")
    assert "local/desk episode 1, observation.images.front" in (tmp_path / "new" / "report.html").read_text()
    assert run(*arguments, "--variants", "2", *FAST) == 2
    assert "exists already" in capsys.readouterr().err
    assert content(tmp_path / "new") == before


@pytest.fixture
def half_broken_desk(desk: Path, tmp_path: Path) -> Path:
    """Two episodes in two mp4 files, the second of which ends in the middle."""
    from lerobot_msdyn.dataset.provenance import Provenance
    from lerobot_msdyn.dataset.read import open_source
    from lerobot_msdyn.dataset.write import NewEpisode, OutputDataset

    root = tmp_path / "broken"
    source = open_source("local/desk", desk)
    source.info.video_files_size_in_mb = 1e-6  # one episode per file
    with OutputDataset(source, "local/desk", root) as output:
        output.finish([NewEpisode(i, Provenance("local/desk", i, -1, 0)) for i in range(2)], "")
    files = sorted((root / "videos" / FRONT).rglob("*.mp4"))
    assert len(files) == 2
    files[1].write_bytes(files[1].read_bytes()[: files[1].stat().st_size * 2 // 3])
    return root


def test_a_fault_in_one_episode_does_not_cost_the_others(
    desk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = job.augment_episode

    def faulty(source: Any, index: int, *rest: Any) -> object:
        if index == 0:
            raise RuntimeError("a fault")
        return whole(source, index, *rest)

    monkeypatch.setattr(job, "augment_episode", faulty)
    arguments = ["--repo", "local/desk", "--root", str(desk), "--new_root", str(tmp_path / "new")]
    assert run(*arguments, "--episodes", "[0,1]", "--cameras", "[front]", "--variants", "1", *FAST) == 1
    assert "skipped: local/desk episode 0: RuntimeError: a fault" in capsys.readouterr().out
    assert LeRobotDataset("local/desk_msdyn", root=tmp_path / "new", video_backend="pyav").num_episodes == 2


def test_one_absent_file_is_one_line_before_anything_is_done(
    desk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "broken"
    shutil.copytree(desk, root)
    shutil.rmtree(root / "videos" / SIDE)
    monkeypatch.setattr(job, "attempt", lambda *_: pytest.fail("work is done"))
    arguments = ["--repo", "local/desk", "--root", str(root), "--new_root", str(tmp_path / "new")]
    assert run(*arguments, "--cameras", "[front]", *FAST) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if "is absent" in line]
    assert len(lines) == 2, lines
    assert "skipped: local/desk episode 0: " in lines[0]
    assert "First: local/desk episodes 0 to 2: " in lines[1]


def copies_only(source: Any, index: int, *_: Any) -> list[Any]:
    """In place of `augment_episode`: the recorded episode alone."""
    from lerobot_msdyn.dataset.provenance import SOURCE_VARIANT, Provenance
    from lerobot_msdyn.dataset.write import NewEpisode

    return [NewEpisode(index, Provenance(source.repo_id, index, SOURCE_VARIANT, 0))]


def test_what_a_killed_recorder_left(
    desk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from lerobot_msdyn.augment import run as job

    monkeypatch.setattr(job, "augment_episode", copies_only)
    root = tmp_path / "killed"
    shutil.copytree(desk, root)
    info = root / "meta" / "info.json"
    info.write_text(json.dumps(json.loads(info.read_text()) | {"total_episodes": 105, "total_frames": 5000}))
    arguments = ["--repo", "local/killed", "--root", str(root), "--scene.shared_background", "false"]
    assert run(*arguments, "--new_root", str(tmp_path / "new")) == 1
    printed = capsys.readouterr()
    assert "skipped: local/killed episodes 3 to 104: lost" in printed.out
    assert LeRobotDataset("local/new", root=tmp_path / "new", video_backend="pyav").num_episodes == 3
    assert run(*arguments, "--new_root", str(tmp_path / "some"), "--episodes", "[0,2]") == 0
    assert run(*arguments, "--new_root", str(tmp_path / "none"), "--episodes", "[50]") == 2
    assert "episode 50 is lost" in capsys.readouterr().err


def test_what_can_be_checked_first_is_checked_first(
    desk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from lerobot_msdyn.augment import cost
    from lerobot_msdyn.augment import run as job

    def begun(*_: Any) -> None:
        raise AssertionError("the work has begun")

    monkeypatch.setattr(job, "augment_episode", begun)
    monkeypatch.setattr(cost.shutil, "disk_usage", lambda folder: shutil._ntuple_diskusage(10, 10, 0))
    arguments = ["--repo", "local/desk", "--root", str(desk)]
    assert run(*arguments, "--new_root", str(tmp_path / "new")) == 2
    assert f"{tmp_path} has 0 MB of free disk; the output takes about" in capsys.readouterr().err
    assert run(*arguments, "--new_repo_id", "local/../../up") == 2
    assert "expected a name as local/desk" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def content(root: Path) -> dict[Path, bytes]:
    """All files of a folder."""
    return {path.relative_to(root): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def test_a_run_that_was_stopped_goes_on_and_gives_the_same_files(
    desk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = job.augment_episode
    begun: list[int] = []

    def stopped(source: Any, index: int, *rest: Any) -> object:
        if index == 2 and begun:
            raise KeyboardInterrupt
        begun.append(index)
        return whole(source, index, *rest)

    arguments = ["--repo", "local/desk", "--root", str(desk), "--episodes", "[0,2]", "--cameras", "[front]"]
    arguments += ["--variants", "1", *FAST, "--new_repo_id", "local/new"]
    monkeypatch.setattr(job, "augment_episode", stopped)
    assert run(*arguments, "--new_root", str(tmp_path / "new")) == 130
    said = capsys.readouterr().err
    assert f"interrupted: kept in {tmp_path / '.new.partial'}: 1 finished episodes, the shared background; the" in said
    assert not (tmp_path / "new").exists()
    assert run(*arguments, "--new_root", str(tmp_path / "new"), "--fit.steps", "9") == 2
    assert "started differently: fit.steps was 8, is 9. Start it as before" in capsys.readouterr().err
    monkeypatch.setattr(job, "augment_episode", whole)
    assert run(*arguments, "--new_root", str(tmp_path / "new")) == 0
    assert run(*arguments, "--new_root", str(tmp_path / "whole")) == 0
    first, second = (
        {
            path.relative_to(tmp_path / name): path.read_bytes()
            for path in (tmp_path / name).rglob("*")
            if path.is_file() and path.name != "report.html"  # which says how long things took
        }
        for name in ("new", "whole")
    )
    assert first == second
    assert sorted(path.name for path in tmp_path.iterdir()) == ["new", "whole"]
    assert begun == [0]


@pytest.mark.parametrize("moment", ["background", "episode"])
def test_an_interrupted_run_keeps_what_it_says(
    desk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, moment: str
) -> None:
    def stopped(*_: Any) -> None:
        raise KeyboardInterrupt

    where, what = (workers, "seen_together") if moment == "background" else (job, "augment_episode")
    monkeypatch.setattr(where, what, stopped)
    arguments = ["--repo", "local/desk", "--root", str(desk), "--new_root", str(tmp_path / "new")]
    arguments += ["--cameras", "[front]", "--variants", "1", "--workers", "1", *FAST]
    assert run(*arguments) == 130
    said, kept = capsys.readouterr().err.splitlines()[-1], tmp_path / ".new.partial" / "backgrounds.safetensors"
    if moment == "background":
        assert said == "interrupted: nothing was finished yet, and nothing is kept"
        assert list(tmp_path.iterdir()) == []
        return
    folder = kept.parent
    assert said == f"interrupted: kept in {folder}: the shared background; the same command goes on from there"
    before = kept.stat().st_mtime_ns
    assert run(*arguments) == 130
    assert kept.stat().st_mtime_ns == before


def test_states_that_are_no_numbers_cost_their_episode_only(
    desk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "nan"
    shutil.copytree(desk, root)
    path = next((root / "data").rglob("*.parquet"))
    table = pq.read_table(path)
    states = table["observation.state"].to_pylist()
    states[12][3] = float("nan")
    field = table.schema.field("observation.state")
    position = table.column_names.index(field.name)
    pq.write_table(table.set_column(position, field, pa.array(states, field.type)), path)
    arguments = ["--repo", "local/desk", "--root", str(root), "--new_root", str(tmp_path / "new")]
    assert run(*arguments, "--episodes", "[0,1]", "--cameras", "[front]", "--variants", "1", *FAST) == 1
    printed = capsys.readouterr().out
    assert "1 of 2 episodes, 1 new ones" in printed
    assert "skipped: local/desk episode 1: in" in printed
    assert "observation.state is not a number in 1 of 12 rows" in printed


def test_as_a_module() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "lerobot_msdyn.augment", "--variantz", "3"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert done.stderr == "error: command line: unknown field 'variantz', did you mean 'variants'?\n"
