"""Models on this machine: where they are looked for, and what is said when they are absent."""

from pathlib import Path

import pytest
from huggingface_hub import constants

from lerobot_msdyn.core.config import PriorsConfig
from lerobot_msdyn.priors.hub import demand_library, find_model, has_library, local_model
from lerobot_msdyn.priors.models import MODELS, NON_COMMERCIAL, UNKNOWN_LICENCE, known_as, licence_of
from lerobot_msdyn.priors.registry import Unusable

SAM2 = "facebook/sam2.1-hiera-tiny"


def put_in_cache(home: Path, name: str, weights: bool = True, revision: str = "0123abcd") -> None:
    """As `hf download` leaves a model, or, of a revision other than the newest, `models fetch`."""
    folder = home / f"models--{name.replace('/', '--')}"
    snapshot = folder / "snapshots" / revision
    snapshot.mkdir(parents=True)
    if revision == "0123abcd":
        (folder / "refs").mkdir()
        (folder / "refs" / "main").write_text(revision)
    (snapshot / "config.json").write_text("{}")
    if weights:
        (snapshot / "model.safetensors").write_bytes(b"")


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
    return tmp_path


def test_a_cached_model_comes_with_its_revision_and_licence(hub: Path) -> None:
    assert find_model(SAM2) is None
    put_in_cache(hub, SAM2)
    model = find_model(SAM2)
    assert model is not None
    assert (model.revision, model.licence) == ("0123abcd", "Apache-2.0")
    assert (model.folder / "config.json").is_file()


def test_a_model_without_weights_does_not_count(hub: Path) -> None:
    put_in_cache(hub, SAM2, weights=False)
    assert find_model(SAM2) is None


def test_a_missing_model_is_named_with_the_command_that_fetches_it(hub: Path) -> None:
    pytest.importorskip("transformers")
    with pytest.raises(
        Unusable, match=f"{SAM2} is not on this machine; fetch .*: python -m lerobot_msdyn.models fetch sam2$"
    ):
        local_model(SAM2)
    with pytest.raises(Unusable, match=r"me/mine is not on this machine; fetch it with: hf download me/mine$"):
        local_model("me/mine")
    put_in_cache(hub, SAM2)
    assert local_model(SAM2).licence == "Apache-2.0"
    put_in_cache(hub, "me/mine")
    with pytest.raises(Unusable, match=r"configuration of timm/x as well; fetch .*hf download timm/x config\.json"):
        local_model("me/mine", companion="timm/x")
    put_in_cache(hub, "timm/x", weights=False)
    assert local_model(SAM2, companion="timm/x") == local_model(SAM2)


def test_the_revision_that_is_meant_goes_before_the_newest(hub: Path) -> None:
    meant = MODELS["sam2"].revision
    put_in_cache(hub, SAM2, revision=meant)
    found = find_model(SAM2)
    assert found is not None
    assert found.revision == meant
    put_in_cache(hub, SAM2)
    assert find_model(SAM2) == found


def test_a_provider_states_the_licence_of_its_own_model(hub: Path) -> None:
    put_in_cache(hub, "me/my_model")
    for licence, stated in (("MIT", "MIT"), (UNKNOWN_LICENCE, "unknown: read its model card")):
        model = find_model("me/my_model", licence)
        assert model is not None
        assert model.licence == stated


@pytest.mark.parametrize("name", ["no such thing", "/absent/folder", "a/b/c", ""])
def test_names_that_cannot_be_ids_are_not_found(hub: Path, name: str) -> None:
    assert find_model(name) is None


def test_a_missing_library_is_named_with_the_command_that_installs_it() -> None:
    assert has_library("torch")
    with pytest.raises(Unusable, match=r"it needs no_such_library; install .*: pip install 'lerobot_msdyn\[sfm\]'"):
        demand_library("no_such_library", "sfm", "it")


def test_no_default_is_restricted_to_non_commercial_use() -> None:
    config = PriorsConfig()
    defaults = [getattr(config, name) for name in vars(config) if name.endswith("_model")]
    assert len(defaults) == 4
    assert all(known_as(name) for name in defaults)
    assert all(licence_of(name) not in (NON_COMMERCIAL, UNKNOWN_LICENCE) for name in defaults)
