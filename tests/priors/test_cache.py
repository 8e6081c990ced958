"""Kept results: found again, apart for other settings, whole or not at all."""

import logging
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_msdyn.core.files import cache_folder
from lerobot_msdyn.core.plugins import _from_file
from lerobot_msdyn.priors import cache as cache_module
from lerobot_msdyn.priors.cache import PriorCache, open_cache, save_npz

RGB = torch.randint(0, 255, (3, 8, 8, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))


class Counter:
    """Computes, and counts how often."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self) -> dict[str, np.ndarray]:
        self.calls += 1
        return {"x": np.arange(100) + self.calls}


def test_the_same_settings_are_computed_once(tmp_path: Path) -> None:
    compute = Counter()
    cache = open_cache(str(tmp_path), RGB)
    first = cache.get("depth", "plane", {"a": 1}, compute)
    again = open_cache(str(tmp_path), RGB.clone()).get("depth", "plane", {"a": 1}, compute)
    assert compute.calls == 1
    np.testing.assert_array_equal(first["x"], again["x"])
    cache.get("depth", "plane", {"a": 2}, compute)
    cache.get("depth", "stereo", {"a": 1}, compute)
    changed = RGB.clone()
    changed[2, 7, 7, 2] ^= 1
    open_cache(str(tmp_path), changed).get("depth", "plane", {"a": 1}, compute)
    assert compute.calls == 4


def test_results_of_other_code_are_not_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compute = Counter()
    cache = open_cache(str(tmp_path), RGB)
    cache.get("depth", "plane", {}, compute)
    monkeypatch.setattr(cache_module, "code_digest", lambda folder: "newer")
    cache.get("depth", "plane", {}, compute)
    assert compute.calls == 2


def test_results_of_another_provider_s_older_code_are_not_found(tmp_path: Path) -> None:
    cache, path = open_cache(str(tmp_path / "cache"), RGB), tmp_path / "mine.py"
    for number in (1, 1, 10):  # another length: modules are compiled anew by size and time
        path.write_text(f"import numpy as np\ndef compute():\n    return {{'x': np.full(1, {number})}}\n")
        module = _from_file(path)
        assert cache.get("depth", "mine", {}, module.compute)["x"] == [number]
    del sys.modules[module.__name__]
    assert len(list((tmp_path / "cache").rglob("*.npz"))) == 2


@pytest.mark.parametrize("damage", ["cut", "flipped", "empty"])
def test_a_damaged_file_is_computed_again(tmp_path: Path, damage: str, caplog: pytest.LogCaptureFixture) -> None:
    compute = Counter()
    cache = open_cache(str(tmp_path), RGB)
    cache.get("depth", "plane", {}, compute)
    (path,) = tmp_path.rglob("*.npz")
    content = bytearray(path.read_bytes())
    if damage == "flipped":
        content[len(content) // 2] ^= 255
    damaged: dict[str, bytes | bytearray] = {"cut": content[: len(content) // 2], "flipped": content, "empty": b""}
    path.write_bytes(damaged[damage])
    with caplog.at_level(logging.WARNING):
        assert cache.get("depth", "plane", {}, compute)["x"][0] == 2
    assert "damaged" in caplog.text
    assert cache.get("depth", "plane", {}, compute)["x"][0] == 2


def test_off_keeps_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LEROBOT_MSDYN_CACHE", str(tmp_path))
    compute = Counter()
    for _ in range(2):
        open_cache("off", RGB).get("depth", "plane", {}, compute)
    assert compute.calls == 2
    assert list(tmp_path.iterdir()) == []


def test_the_environment_names_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LEROBOT_MSDYN_CACHE", str(tmp_path / "mine"))
    assert cache_folder("priors") == tmp_path / "mine"
    monkeypatch.delenv("LEROBOT_MSDYN_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder("priors") == tmp_path / "lerobot_msdyn" / "priors"


def test_a_file_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    with pytest.raises(ValueError):
        save_npz(tmp_path / "x.npz", {"x": np.array([object()])})
    assert list(tmp_path.iterdir()) == []


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "file").write_text("")
    arrays = PriorCache(tmp_path / "file" / "x").get("depth", "plane", {}, Counter())
    assert arrays["x"][0] == 1
    assert "cannot be written" in caplog.text
