"""Values come back from their files bit for bit."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from lerobot_msdyn.core import serialise
from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.serialise import ValueFileError, load_value, save_value
from lerobot_msdyn.dataset.encode import StagedPictures
from lerobot_msdyn.dataset.provenance import Provenance


def same(a: Any, b: Any) -> bool:
    if isinstance(a, torch.Tensor):
        return a.dtype == b.dtype and torch.equal(a.nan_to_num(7), b.nan_to_num(7))
    if isinstance(a, np.ndarray):
        return bool(a.dtype == b.dtype and np.array_equal(a, b))
    if dataclasses.is_dataclass(a):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    return bool(a == b)


@pytest.mark.parametrize("small", [0, serialise.SMALL])
def test_round_trip(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small: int) -> None:
    monkeypatch.setattr(serialise, "SMALL", small)
    camera = CameraTrack(torch.eye(3).expand(2, 3, 3), torch.eye(4).repeat(2, 1, 1), 64, 48)
    value = {
        "camera": camera,
        "numbers": [1, 0.1 + 0.2, math.inf, True, None, "text"],
        "arrays": (np.arange(6, dtype=np.float64).reshape(2, 3).T, torch.zeros(0, 3), torch.tensor(float("nan"))),
        "pictures": StagedPictures({"a": tmp_path / "v" / "a.mp4"}, {}, {"a": {"mean": np.ones((3, 1, 1))}}),
        "provenance": Provenance("local/desk", 1, 0, 0, {"a": {"azimuth_deg": 0.1}}),
    }
    save_value(tmp_path / "value", value, tmp_path)
    assert same(load_value(tmp_path / "value", tmp_path), value)
    moved = load_value(tmp_path / "value", Path("/elsewhere"))
    assert moved["pictures"].videos == {"a": Path("/elsewhere/v/a.mp4")}


def test_what_cannot_be_kept(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="a set cannot be kept"):
        save_value(tmp_path / "value", {1, 2}, tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("small", [0, serialise.SMALL])
@pytest.mark.parametrize("content", [b"", b"{}", b"\x00" * 100])
def test_a_damaged_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: bytes, small: int) -> None:
    monkeypatch.setattr(serialise, "SMALL", small)
    (tmp_path / "value").write_bytes(content)
    with pytest.raises(ValueFileError, match="cannot be read"):
        load_value(tmp_path / "value", tmp_path)


def test_only_dataclasses_of_this_package_are_made(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    for name in ("subprocess:Popen", "lerobot_msdyn.core.cli:run_command", "lerobot_msdyn.absent:X"):
        header = json.dumps({"class": name, "fields": {}})
        save_file({}, tmp_path / "value", {"value": header})
        with pytest.raises(ValueFileError, match="cannot be read"):
            load_value(tmp_path / "value", tmp_path)
