"""Randomly initialised models of the real classes, small enough for a test, saved as the hub's are."""

from pathlib import Path

import torch
from transformers import (
    DepthAnythingConfig,
    DepthAnythingForDepthEstimation,
    Dinov2Config,
    DPTImageProcessor,
    EdgeTamVideoConfig,
    EdgeTamVideoModel,
    Sam2ImageProcessor,
    Sam2VideoConfig,
    Sam2VideoModel,
    Sam2VideoProcessor,
    Sam2VideoVideoProcessor,
    TimmWrapperConfig,
)
from transformers.models.edgetam.configuration_edgetam import EdgeTamVisionConfig
from transformers.models.edgetam_video.configuration_edgetam_video import (
    EdgeTamVideoMaskDecoderConfig,
    EdgeTamVideoPromptEncoderConfig,
)
from transformers.models.sam2.configuration_sam2 import Sam2HieraDetConfig, Sam2VisionConfig
from transformers.models.sam2_video.configuration_sam2_video import (
    Sam2VideoMaskDecoderConfig,
    Sam2VideoPromptEncoderConfig,
)

SIDE = 128  # px, of the pictures that the SAM models see
HIDDEN = 128
_SCALES = [[SIDE // 4] * 2, [SIDE // 8] * 2, [SIDE // 16] * 2]
_PROMPTS = {"hidden_size": HIDDEN, "image_size": SIDE, "mask_input_channels": 4}
_DECODER = {"hidden_size": HIDDEN, "mlp_dim": 32, "num_attention_heads": 2, "iou_head_hidden_dim": 32}
_MEMORY = {
    "image_size": SIDE,
    "memory_attention_hidden_size": HIDDEN,
    "memory_attention_num_layers": 1,
    "memory_attention_rope_feat_sizes": _SCALES[-1],
    "memory_encoder_hidden_size": HIDDEN,
    "mask_downsampler_embed_dim": HIDDEN,
    "memory_fuser_embed_dim": HIDDEN,
    "memory_fuser_intermediate_dim": 32,
}


def save_depth_anything(folder: Path, kind: str) -> Path:
    """A `relative` or `metric` Depth Anything."""
    torch.manual_seed(0)
    backbone = Dinov2Config(
        hidden_size=24,
        num_hidden_layers=4,
        num_attention_heads=2,
        image_size=56,
        patch_size=14,
        out_indices=[1, 2, 3, 4],
        reshape_hidden_states=False,
    )
    config = DepthAnythingConfig(
        backbone_config=backbone,
        reassemble_hidden_size=24,
        neck_hidden_sizes=[8, 8, 8, 8],
        fusion_hidden_size=8,
        head_hidden_size=8,
        depth_estimation_type=kind,
        max_depth=20,
    )
    DepthAnythingForDepthEstimation(config).save_pretrained(folder)
    size = {"height": 56, "width": 56}
    DPTImageProcessor(size=size, ensure_multiple_of=14, keep_aspect_ratio=True).save_pretrained(folder)
    return folder


def save_sam2(folder: Path) -> Path:
    """A SAM 2 video model."""
    torch.manual_seed(0)
    backbone = Sam2HieraDetConfig(
        hidden_size=8,
        image_size=[SIDE, SIDE],
        blocks_per_stage=[1, 1, 2, 1],
        embed_dim_per_stage=[8, 16, 32, 64],
        num_attention_heads_per_stage=[1, 1, 2, 2],
        window_size_per_stage=[8, 4, 4, 4],
        global_attention_blocks=[3],
    )
    vision = Sam2VisionConfig(
        backbone_config=backbone,
        backbone_channel_list=[64, 32, 16, 8],
        backbone_feature_sizes=_SCALES,
        fpn_hidden_size=HIDDEN,
    )
    config = Sam2VideoConfig(
        vision_config=vision,
        prompt_encoder_config=Sam2VideoPromptEncoderConfig(**_PROMPTS),
        mask_decoder_config=Sam2VideoMaskDecoderConfig(**_DECODER),
        memory_attention_feed_forward_hidden_size=32,
        **_MEMORY,
    )
    Sam2VideoModel(config).save_pretrained(folder)
    _processor().save_pretrained(folder)
    return folder


def save_edgetam(folder: Path) -> Path:
    """An EdgeTAM video model; its backbone is timm's, with random weights."""
    torch.manual_seed(0)
    backbone = TimmWrapperConfig(
        architecture="repvit_m1",
        model_args={"in_chans": 3, "features_only": True, "out_indices": [0, 1, 2, 3]},
    )
    vision = EdgeTamVisionConfig(
        backbone_config=backbone,
        backbone_channel_list=[384, 192, 96, 48],
        backbone_feature_sizes=_SCALES,
        fpn_hidden_size=HIDDEN,
    )
    config = EdgeTamVideoConfig(
        vision_config=vision,
        prompt_encoder_config=EdgeTamVideoPromptEncoderConfig(**_PROMPTS),
        mask_decoder_config=EdgeTamVideoMaskDecoderConfig(**_DECODER),
        memory_attention_mlp_hidden_size=32,
        memory_attention_rope_k_sizes=[4, 4],
        perceiver_resampler_num_latents=16,
        perceiver_resampler_num_latents_2d=16,
        **_MEMORY,
    )
    network = EdgeTamVideoModel(config)
    # Not save_pretrained: it compares with the default config, for which transformers asks the hub.
    folder.mkdir(parents=True, exist_ok=True)
    config.architectures = ["EdgeTamVideoModel"]
    config.to_json_file(folder / "config.json", use_diff=False)
    from safetensors.torch import save_model

    save_model(network, str(folder / "model.safetensors"), metadata={"format": "pt"})
    _processor().save_pretrained(folder)
    return folder


def _processor() -> Sam2VideoProcessor:
    size, mask_size = {"height": SIDE, "width": SIDE}, {"height": SIDE // 4, "width": SIDE // 4}
    return Sam2VideoProcessor(Sam2ImageProcessor(size=size, mask_size=mask_size), Sam2VideoVideoProcessor(size=size))
