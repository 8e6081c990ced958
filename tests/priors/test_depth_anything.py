"""Depth Anything, with random weights: what goes in and comes out, not how good it is."""

from pathlib import Path

import pytest
import torch

pytest.importorskip("transformers")

from tiny_models import save_depth_anything

from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.priors.depth.depth_anything import predict_depth
from lerobot_msdyn.priors.hub import find_model

RGB = torch.randint(0, 255, (5, 48, 64, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("kind", ["relative", "metric"])
def test_every_frame_gets_depth_at_its_own_size(kind: str, tmp_path: Path) -> None:
    model = find_model(str(save_depth_anything(tmp_path, kind)))
    assert model is not None
    assert (model.revision, model.licence) == ("local", "unknown: read its model card")
    depth, metric = predict_depth(RGB, model, "cpu")
    assert metric == (kind == "metric")
    assert depth.shape == (5, 48, 64)
    assert torch.isfinite(depth).all()
    if metric:
        assert 0 < depth.mean() < 20


def test_a_folder_with_something_else_is_named(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text('{"model_type": "bert"}')
    (tmp_path / "model.safetensors").write_bytes(b"")
    model = find_model(str(tmp_path))
    assert model is not None
    with pytest.raises(PriorError, match="no Depth Anything model"):
        predict_depth(RGB, model, "cpu")
