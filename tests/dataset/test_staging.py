"""The work folder: what is finished is kept, and kept apart."""

from pathlib import Path

import pytest

from lerobot_msdyn.core.errors import EpisodeError, OutputError
from lerobot_msdyn.dataset.staging import FINISHED, Staging, differences, published_before, work_folder

RUN = {"recipe": {"variants": 2, "fit": {"steps": 8}}, "source": {"meta/info.json": "a", "data/x": "b"}}


def test_a_value_is_made_once(tmp_path: Path) -> None:
    made = []

    def make() -> list[int]:
        made.append(1)
        return [1, 2]

    for _ in range(2):
        with Staging(tmp_path / "out") as staging:
            staging.agree(RUN)
            assert staging.episode(3).keep(FINISHED, make) == [1, 2]
            assert staging.finished() == 1
    assert made == [1]


def test_a_damaged_value_is_made_again(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with Staging(tmp_path / "out") as staging:
        kept = staging.episode(0)
        kept.keep("scene_a", lambda: 1)
        (kept.folder / "scene_a.safetensors").write_bytes(b"half")
        assert kept.keep("scene_a", lambda: 2) == 2
        assert "it is made again" in caplog.text
        kept.forget("scene")
        assert list(kept.folder.iterdir()) == []


def test_a_failure_keeps_nothing(tmp_path: Path) -> None:
    def fail() -> None:
        raise EpisodeError("broken")

    with Staging(tmp_path / "out") as staging, pytest.raises(EpisodeError):
        staging.episode(0).keep(FINISHED, fail)
    assert not work_folder(tmp_path / "out").exists()


def test_another_run_is_named_and_not_mixed_in(tmp_path: Path) -> None:
    with Staging(tmp_path / "out") as staging:
        staging.agree(RUN)
        staging.episode(0).keep(FINISHED, lambda: 1)
    other = {"recipe": {"variants": 2, "fit": {"steps": 9}}, "source": {"meta/info.json": "a", "data/x": "c"}}
    with Staging(tmp_path / "out") as staging:
        with pytest.raises(OutputError, match=r"fit.steps was 8, is 9; source: data/x has changed\. .*--restart"):
            staging.agree(other)
        assert staging.finished() == 1
        staging.agree(other, restart=True)
        assert staging.finished() == 0
        staging.agree(other)


CODE = "the code of lerobot_msdyn has changed"


def test_a_run_of_other_code_is_told_in_plain_words(tmp_path: Path) -> None:
    with Staging(tmp_path / "out") as staging:
        staging.agree(RUN | {"versions": {"code": "0a1b"}})
        staging.episode(0).keep(FINISHED, lambda: 1)
    with Staging(tmp_path / "out") as staging:
        with pytest.raises(OutputError, match=r"code has changed since.*Go on with the version.*--restart") as caught:
            staging.agree(RUN | {"versions": {"code": "2c3d"}})
        assert "0a1b" not in str(caught.value)
        changed = {"recipe": {"variants": 3}, "source": {f"data/{i}": "c" for i in range(9)}, "versions": {"code": "2"}}
        with pytest.raises(OutputError, match=rf"differently: {CODE}; .*as before, with the version of lerobot_msdyn"):
            staging.agree(changed)
        assert staging.finished() == 1


def test_one_run_at_a_time(tmp_path: Path) -> None:
    with Staging(tmp_path / "out"), pytest.raises(OutputError, match=r"out is being written by process \d+ on "):
        Staging(tmp_path / "out")
    with Staging(tmp_path / "out"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        Staging(tmp_path / "file" / "out")


def test_stopped_right_after_the_dataset_was_moved(tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert published_before(out) is None
    with Staging(out) as staging:
        dataset = staging.folder / "dataset"
        dataset.mkdir()
        staging.publish(dataset, out, ["episode 1"])
    assert published_before(out) is None
    folder = work_folder(out)
    folder.mkdir()
    (folder / "published.json").write_text('["episode 1"]')
    assert published_before(out) == ["episode 1"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]


def test_differences_by_name() -> None:
    before = {"recipe": {"cameras": None}, "source": {"a": "1", "b": "2"}, "versions": {"torch": "1"}}
    now = {"recipe": {"cameras": ["x"]}, "source": {"b": "absent", "c": "3"}, "versions": {"torch": "2"}}
    before, now = before | {"plugins": {"/x/mine.py": "1"}}, now | {"plugins": {"/x/mine.py": "2"}}
    assert differences(before, now) == [
        "plugins: /x/mine.py has changed",
        "cameras was None, is ['x']",
        "source: a is gone",
        "source: b is gone",
        "source: c is new",
        "versions.torch was 1, is 2",
    ]
