"""Masks by SAM 2 (Ravi et al., 2024) or EdgeTAM (Zhou et al., CVPR 2025), through transformers.

Nobody clicks: each instance that the weights-free masks found is shown to the network once, in the frame in which its
mask is most trustworthy, and followed from there to both ends of the clip. The network outlines things better and
follows what rests; what the weights-free masks did not find at all stays unfound.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.priors.hub import LocalModel

_MEMORY = 32  # frames that a session keeps; the networks look back at 16 at most
_CENTRAL = 0.5  # quantile of an instance's areas to which the best frame's is compared


def sam2_masks(
    rgb: UInt8[Tensor, "t h w 3"], prompts: UInt8[Tensor, "t h w"], model: LocalModel, device: str
) -> UInt8[Tensor, "t h w"]:
    """Instances of every frame; `prompts` are weights-free masks, whose instance numbers are kept.

    Where two instances claim a pixel, the more confident one gets it.

    Raises:
        PriorError: the folder does not hold such a model.
    """
    processor, network = _load(model)
    network.to(device)
    best = torch.zeros(prompts.shape, dtype=torch.float16)  # logit; 0 decides between inside and outside
    instances = torch.zeros_like(prompts)
    for instance in range(1, int(prompts.max()) + 1):
        mask = prompts == instance
        if not bool(mask.any()):
            continue
        for frame, logits in _followed(rgb, mask, best_frame(mask), processor, network, device):
            wins = logits > best[frame]
            instances[frame][wins] = instance
            best[frame][wins] = logits[wins]
    return instances


def best_frame(mask: Bool[Tensor, "t h w"]) -> int:
    """The frame in which an instance's mask is most trustworthy.

    It is compact and not cut off by the image's border, and neither a sliver nor a merger of two things: its area is
    about the usual one.
    """
    area = mask.sum((1, 2)).float()
    seen = area > 0
    usual = area[seen].quantile(_CENTRAL)
    filled = torch.nn.functional.pad(mask, (1, 1, 1, 1))
    outline = (filled[:, 1:] != filled[:, :-1]).sum((1, 2)) + (filled[:, :, 1:] != filled[:, :, :-1]).sum((1, 2))
    compact = 16 * area / outline.clamp(min=1).float().square()  # 1 for a square
    border = mask[:, 0].sum(1) + mask[:, -1].sum(1) + mask[:, :, 0].sum(1) + mask[:, :, -1].sum(1)
    typical = torch.minimum(area / usual, usual / area.clamp(min=1))
    score = compact * typical * (1 - border / outline.clamp(min=1))
    return int(torch.where(seen, score, -1).argmax())


def _followed(
    rgb: UInt8[Tensor, "t h w 3"], mask: Bool[Tensor, "t h w"], start: int, processor: Any, network: Any, device: str
) -> Iterator[tuple[int, Float[Tensor, "h w"]]]:
    """(frame, logits of the instance) for all frames, by one session that is told the instance at `start`."""
    session = processor.init_video_session(inference_device=device)
    session.processed_frames = _Frames(rgb, processor, device)
    session.video_height, session.video_width = rgb.shape[1:3]
    processor.add_inputs_to_inference_session(session, frame_idx=start, obj_ids=1, input_masks=mask[start].numpy())
    with torch.inference_mode():
        for reverse in (False, True):
            for output in network.propagate_in_video_iterator(session, start_frame_idx=start, reverse=reverse):
                logits = processor.post_process_masks(
                    [output.pred_masks], original_sizes=[list(rgb.shape[1:3])], binarize=False
                )[0][0, 0]
                yield output.frame_idx, logits.to("cpu", torch.float16)
                kept = session.output_dict_per_obj[0]["non_cond_frame_outputs"]
                for old in [frame for frame in kept if abs(frame - output.frame_idx) > _MEMORY]:
                    del kept[old]


class _Frames:
    """The frames of a session, prepared when they are asked for: prepared, a clip is some 12 MB per frame."""

    def __init__(self, rgb: UInt8[Tensor, "t h w 3"], processor: Any, device: str) -> None:
        self._rgb, self._processor, self._device = rgb, processor, device

    def __len__(self) -> int:
        return len(self._rgb)

    def __getitem__(self, frame: int) -> Tensor:
        picture = np.ascontiguousarray(self._rgb[frame].cpu().numpy())
        inputs = self._processor.video_processor(videos=picture[None], device=self._device, return_tensors="pt")
        prepared: Tensor = inputs.pixel_values_videos[0][0]
        return prepared


def _load(model: LocalModel) -> tuple[Any, Any]:
    from transformers import AutoConfig, EdgeTamVideoModel, Sam2VideoModel, Sam2VideoProcessor

    try:
        kind = AutoConfig.from_pretrained(model.folder, local_files_only=True).model_type
        network_class = EdgeTamVideoModel if kind.startswith("edgetam") else Sam2VideoModel
        processor = Sam2VideoProcessor.from_pretrained(model.folder, local_files_only=True)
        network = network_class.from_pretrained(model.folder, local_files_only=True)
    except (OSError, ValueError, KeyError, RuntimeError, ImportError) as error:
        line = str(error).strip().splitlines()[0] if str(error).strip() else ""
        raise PriorError(
            f"{model.name} in {model.folder} cannot be loaded as a SAM 2 video model ({type(error).__name__}: {line})"
        ) from error
    return processor, network.eval()
