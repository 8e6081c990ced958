"""On a GPU: how many workers it has room for, and that a full one costs its episode only."""

from unittest.mock import Mock

import pytest
import torch

from lerobot_msdyn.augment import run as job
from lerobot_msdyn.augment import workers
from lerobot_msdyn.augment.config import AugmentConfig


@pytest.mark.parametrize(("device", "expected"), [("cuda", 2), ("cpu", 5)])
def test_workers_share_the_memory_of_a_gpu(monkeypatch: pytest.MonkeyPatch, device: str, expected: int) -> None:
    monkeypatch.setattr(workers, "chosen_device", lambda name: torch.device(device))
    monkeypatch.setattr(workers, "cores", lambda: 8)
    monkeypatch.setattr(workers, "_memory", lambda: 64e9)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda: (11_000_000_000, 24_000_000_000))
    assert workers.workers_for(AugmentConfig(), 10_000, 5) == expected
    assert workers.workers_for(AugmentConfig(workers=3), 10_000, 5) == 3


def test_a_full_gpu_costs_its_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    work = Mock(spec=workers.Work, source=Mock(repo_id="local/desk"), output=Mock())
    work.output.finish_episode.side_effect = torch.OutOfMemoryError("CUDA out of memory")
    monkeypatch.setattr(job, "_make", lambda work, index: None)
    reason = job.attempt(work, 3)
    assert reason is not None
    assert reason.startswith("local/desk episode 3: the memory of the GPU is full; try fewer --workers")
