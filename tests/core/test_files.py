"""Files that are complete or absent."""

import errno
import os
import tempfile
from pathlib import Path

import pytest

from lerobot_msdyn.core.errors import OutputError
from lerobot_msdyn.core.files import digest_of_file, temporary_files_in, whole_file, write_whole, writing


def test_a_file_is_replaced_or_left(tmp_path: Path) -> None:
    path = tmp_path / "folder" / "a.mp4"
    write_whole(path, b"old")

    def fail() -> None:
        with whole_file(path) as part:
            assert part.suffix == ".mp4"
            part.write_bytes(b"half")
            raise RuntimeError("stopped")

    with pytest.raises(RuntimeError, match="stopped"):
        fail()
    assert path.read_bytes() == b"old"
    write_whole(path, b"new")
    assert path.read_bytes() == b"new"
    assert list(path.parent.iterdir()) == [path]


def test_a_full_disk_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"x cannot be written \(No space left on device\); what is finished is kept"):  # noqa: SIM117
        with writing(tmp_path / "x"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_temporary_files_go_elsewhere_only_for_the_time(tmp_path: Path) -> None:
    before = tempfile.gettempdir()

    def fail() -> None:
        with temporary_files_in(tmp_path):
            assert Path(tempfile.mkdtemp()).is_relative_to(tmp_path)
            raise RuntimeError("stopped")

    with pytest.raises(RuntimeError, match="stopped"):
        fail()
    assert tempfile.gettempdir() == before


def test_digests(tmp_path: Path) -> None:
    write_whole(tmp_path / "a", b"1")
    write_whole(tmp_path / "b", b"1")
    os.mkfifo(tmp_path / "pipe")
    assert digest_of_file(tmp_path / "a") == digest_of_file(tmp_path / "b") != digest_of_file(tmp_path / "c")
    assert digest_of_file(tmp_path / "pipe") == "absent"
