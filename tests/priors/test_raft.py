"""RAFT, with random weights: what goes in and comes out, and that the tracker takes it."""

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

pytest.importorskip("torchvision")

from torchvision.models.optical_flow import Raft_Small_Weights, raft_small

from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.priors.tracks.flow import flow_tracks
from lerobot_msdyn.priors.tracks.raft import RaftFlow, raft_weights

PAIR = np.random.default_rng(0).integers(0, 255, (2, 72, 100, 3)).astype(np.uint8)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("raft") / "raft.safetensors"
    save_file(raft_small(weights=None).state_dict(), path)
    return path


def test_flow_has_the_size_of_the_pictures(weights: Path) -> None:
    flow = RaftFlow(raft_weights(weights), "cpu")(*PAIR)
    assert flow.shape == (72, 100, 2)
    assert np.isfinite(flow).all()


def test_torchvision_s_own_file_is_found_and_read(
    weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    with pytest.raises(PriorError, match=r"not on this machine; fetch: python -m lerobot_msdyn.models fetch raft"):
        raft_weights(None)
    path = tmp_path / "hub" / "checkpoints" / Path(Raft_Small_Weights.C_T_V2.url).name
    path.parent.mkdir(parents=True)
    torch.save(raft_small(weights=None).state_dict(), path)
    model = raft_weights(None)
    assert (model.revision, model.licence) == ("raft_small_C_T_V2-01064c6d", "BSD-3-Clause")
    RaftFlow(model, "cpu")


def test_bad_weights_are_named(tmp_path: Path) -> None:
    with pytest.raises(PriorError, match=r"there is no .*absent\.pth"):
        raft_weights(tmp_path / "absent.pth")
    other = tmp_path / "other.safetensors"
    save_file({"x": torch.zeros(1)}, other)
    with pytest.raises(PriorError, match="does not hold the weights of raft_small"):
        RaftFlow(raft_weights(other), "cpu")


def test_the_tracker_uses_the_flow_that_it_is_given(sliding) -> None:
    sizes: set[tuple[int, ...]] = set()

    def still(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        sizes.update((a.shape, b.shape))
        return np.zeros((*a.shape[:2], 2), np.float32)

    tracks = flow_tracks(sliding.rgb[:6], sliding.mask[:6].to(torch.uint8), flow=still)
    assert sizes == {(72, 96, 3)}
    assert len(tracks) > 0
