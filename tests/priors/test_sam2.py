"""SAM 2 and EdgeTAM, with random weights: what goes in and comes out, not how good it is."""

import json
from pathlib import Path

import pytest
import torch
from huggingface_hub import constants

pytest.importorskip("transformers")

from tiny_models import save_edgetam, save_sam2

from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.priors.hub import find_model
from lerobot_msdyn.priors.masks.sam2 import best_frame, sam2_masks


@pytest.fixture(scope="module")
def video() -> tuple[torch.Tensor, torch.Tensor]:
    """Six frames, and two things that move."""
    rgb = torch.randint(0, 255, (6, 48, 64, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    prompts = torch.zeros(6, 48, 64, dtype=torch.uint8)
    for t in range(6):
        prompts[t, 5:20, 5 + t : 20 + t] = 1
        prompts[t, 30:40, 30:50] = 2
    return rgb, prompts


@pytest.fixture
def timm_config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What `hf download timm/repvit_m1.dist_in1k config.json` leaves, as far as it is read."""
    folder = tmp_path / "hub" / "models--timm--repvit_m1.dist_in1k"
    (folder / "snapshots" / "0123").mkdir(parents=True)
    (folder / "refs").mkdir()
    (folder / "refs" / "main").write_text("0123")
    content = {"architecture": "repvit_m1", "num_classes": 1000, "num_features": 384, "pretrained_cfg": {}}
    (folder / "snapshots" / "0123" / "config.json").write_text(json.dumps(content))
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub"))


@pytest.mark.parametrize("save", [save_sam2, save_edgetam], ids=["sam2", "edgetam"])
def test_prompted_instances_are_followed_through_the_clip(save, tmp_path: Path, timm_config: None, video) -> None:
    if save is save_edgetam:
        pytest.importorskip("timm")
    model = find_model(str(save(tmp_path / "model")))
    assert model is not None
    rgb, prompts = video
    masks = sam2_masks(rgb, prompts, model, "cpu")
    assert masks.shape == prompts.shape
    assert set(masks.unique().tolist()) <= {0, 1, 2}
    shown = best_frame(prompts == 1)
    overlap = (masks[shown] == 1) & (prompts[shown] == 1)
    assert overlap.sum() > 0.7 * (prompts[shown] == 1).sum(), "in its own frame a prompt is taken as it is"


def test_a_folder_with_something_else_is_named(tmp_path: Path, video) -> None:
    (tmp_path / "config.json").write_text('{"model_type": "bert"}')
    (tmp_path / "model.safetensors").write_bytes(b"")
    model = find_model(str(tmp_path))
    assert model is not None
    rgb, prompts = video
    with pytest.raises(PriorError, match="cannot be loaded as a SAM 2 video model"):
        sam2_masks(rgb, prompts, model, "cpu")


def test_the_best_frame_shows_a_whole_thing_of_the_usual_size() -> None:
    mask = torch.zeros(6, 40, 40, dtype=torch.bool)
    mask[0, 0:10, 0:10] = True  # at the border
    mask[1, 10:20, 10:20] = True
    mask[2, 5:35, 5:35] = True  # merged with another
    mask[3, 10:12, 10:14] = True  # a sliver
    mask[4, 10:20, 10:20] = True
    mask[4, 12:18, 12:18] = False  # with a hole
    assert best_frame(mask) == 1
