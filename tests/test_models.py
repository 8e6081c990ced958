"""The command that lists, fetches and checks learned models; nothing is downloaded here."""

import hashlib
import re
from dataclasses import replace
from pathlib import Path

import httpx
import pytest
import torch
from huggingface_hub import constants

from lerobot_msdyn import models
from lerobot_msdyn.core.errors import ConfigError, PriorError
from lerobot_msdyn.priors import fetch as fetching
from lerobot_msdyn.priors.models import MODELS, NON_COMMERCIAL

CONTENT = b"weights"


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """One without models, and with a hub of its own whose models all have the same weights."""
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "torch"))
    for variable in ("HF_HUB_OFFLINE", "TRANSFORMERS_OFFLINE"):
        monkeypatch.delenv(variable, raising=False)
    digest = hashlib.sha256(CONTENT).hexdigest()
    for name, model in MODELS.items():
        monkeypatch.setitem(MODELS, name, replace(model, sha256=digest if model.sha256 else ""))

    def snapshot(place: str, revision: str, allow_patterns: list[str]) -> None:
        folder = tmp_path / "hub" / f"models--{place.replace('/', '--')}" / "snapshots" / revision
        folder.mkdir(parents=True)
        (folder / "config.json").write_text("{}")
        (folder / "model.safetensors").write_bytes(CONTENT)
        assert "*.json" in allow_patterns

    def single(place: str, name: str) -> None:
        folder = tmp_path / "hub" / f"models--{place.replace('/', '--')}"
        (folder / "snapshots" / "1").mkdir(parents=True)
        (folder / "refs").mkdir()
        (folder / "refs" / "main").write_text("1")
        (folder / "snapshots" / "1" / name).write_text("{}")

    def file(url: str, path: str, hash_prefix: str, progress: bool) -> None:
        assert url.startswith("https://download.pytorch.org/")
        Path(path).write_bytes(CONTENT)

    monkeypatch.setattr(fetching, "snapshot_download", snapshot)
    monkeypatch.setattr(fetching, "hf_hub_download", single)
    monkeypatch.setattr(torch.hub, "download_url_to_file", file)
    return tmp_path


def test_every_model_is_listed_with_what_one_has_to_know(machine: Path, capsys) -> None:
    assert models.run(["ls"]) == 0
    text = capsys.readouterr().out
    for name, model in MODELS.items():
        assert re.search(rf"^{name} +{model.size_mb} MB +{model.licence} +\S", text, re.MULTILINE)
        assert f"    {model.place}" in text
    assert text.count("not here") == len(MODELS)


@pytest.mark.parametrize("name", MODELS)
def test_a_model_is_fetched_once_and_checked(machine: Path, name: str, capsys, monkeypatch) -> None:
    assert models.run(["fetch", name]) == 0
    place = Path(capsys.readouterr().out.strip().removeprefix(f"{name}: "))
    assert place.exists()
    models.run(["ls"])
    assert f"here: {place}\n" in capsys.readouterr().out
    monkeypatch.setattr(fetching, "_download", None)  # must not be called again
    assert models.run(["fetch", name]) == 0
    assert models.run(["check"]) == 0
    assert name in capsys.readouterr().out


@pytest.mark.parametrize("name", ["depth_anything", "raft"])
def test_weights_that_are_not_those_are_named(machine: Path, name: str, capsys) -> None:
    models.run(["fetch", name])
    place = Path(capsys.readouterr().out.strip().removeprefix(f"{name}: "))
    weights = place if place.is_file() else place / "model.safetensors"
    weights.write_bytes(b"others")
    assert models.run(["check"]) == 2
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "as they should be: none is on this machine"
    assert re.match(rf"{name}: {weights} is damaged or of another model \(sha256 \w+, not \w+\): remove it$", said[1])
    with pytest.raises(PriorError, match="damaged or of another model"):
        models.run(["fetch", name])


@pytest.mark.parametrize("kind", [OSError, httpx.ConnectError])  # the hub's library raises either
def test_what_cannot_be_downloaded_is_said_in_a_line(machine: Path, monkeypatch, kind: type[Exception]) -> None:
    def no_network(*args: object, **kwargs: object) -> None:
        raise kind("no route\nto host")

    monkeypatch.setattr(fetching, "snapshot_download", no_network)
    with pytest.raises(
        PriorError, match=rf"sam2 cannot be downloaded from facebook/\S+ \({kind.__name__}: no route\)"
    ) as caught:
        models.run(["fetch", "sam2"])
    assert "\n" not in str(caught.value)


def test_offline_nothing_is_downloaded(machine: Path, monkeypatch) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    with pytest.raises(PriorError, match="raft is not on this machine, and nothing is downloaded while HF_HUB_OFFLINE"):
        models.run(["fetch", "raft"])


@pytest.mark.parametrize("arguments", [["fetch"], ["fetch", "sam3"], ["ls", "sam2"], ["rm", "sam2"]])
def test_wrong_arguments_are_named(arguments: list[str]) -> None:
    with pytest.raises(ConfigError, match=r"models: (got|no model sam3; expected some of depth_anything_metric, )"):
        models.run(arguments)


def test_every_model_is_exactly_named() -> None:
    for name, model in MODELS.items():
        assert model.licence not in ("", NON_COMMERCIAL)
        assert re.fullmatch(r"[0-9a-f]{40}", model.revision) or (model.is_file and model.sha256), name
        assert model.sha256 or name == "edgetam"  # its digest is not known


def test_addresses_are_those_of_torchvision() -> None:
    pytest.importorskip("torchvision")
    from torchvision.models import AlexNet_Weights
    from torchvision.models.optical_flow import Raft_Small_Weights

    assert MODELS["alexnet"].place == AlexNet_Weights.IMAGENET1K_V1.url
    assert MODELS["raft"].place == Raft_Small_Weights.C_T_V2.url
