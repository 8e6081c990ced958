"""Mixed views of a streaming dataset; videos are not streamed here, since their decoder may be absent."""

from pathlib import Path

import torch
from lerobot.datasets import LeRobotDataset, StreamingLeRobotDataset

from lerobot_msdyn.training import MixedStream, MixedViews

FRONT = "observation.images.front"


def test_a_stream_holds_the_samples_of_mixed_views(image_desk: Path, desk_scenes: Path) -> None:
    dataset = LeRobotDataset("local/desk", root=image_desk, video_backend="pyav")
    stream = StreamingLeRobotDataset("local/desk", root=image_desk, buffer_size=4)
    views, mixed = MixedStream(stream, desk_scenes, 0.5), MixedViews(dataset, desk_scenes, 0.5)
    replaced = 0
    for item in views:
        index = int(item["index"])
        assert torch.equal(item[FRONT], mixed[index][FRONT])
        replaced += not torch.equal(item[FRONT], dataset[index][FRONT])
    assert 4 < replaced < 20
    assert views.num_frames == 24
