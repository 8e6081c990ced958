"""A small network of the study's own, for sweeps: minutes per training on a CPU.

Convolutions, the expected place of each feature map (spatial softmax), the joint state, and two layers that give a
chunk of actions.
"""

import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from .forms import Form
from .sets import Row, front_pictures, opened

RATE = 3e-3
LARGEST_GRADIENT = 1.0  # norm
GROUPS = 4  # of channels that are normalised together
SAMPLES_PER_TRANSFORM = 8  # which share a sample of LeRobot's image transforms


@dataclass(frozen=True)
class Frames:
    """A training set in memory."""

    pictures: np.ndarray  # [n, h, w, 3] uint8, at the network's size
    state: np.ndarray  # [n, 6]
    action: np.ndarray  # [n, 6]
    episode: np.ndarray  # [n]
    variant: np.ndarray  # [n], -1 where recorded


def read(root: Path, size: tuple[int, int]) -> Frames:
    """All frames of a dataset, the front camera's pictures at (width, height)."""
    dataset = opened(root)
    pictures = [
        cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        for episode in range(dataset.meta.total_episodes)
        for picture in front_pictures(dataset, episode)
    ]
    rows = dataset.hf_dataset.with_format("numpy")
    state, action, episode = (np.stack(rows[key]) for key in ("observation.state", "action", "episode_index"))
    return Frames(np.stack(pictures), state, action, episode, variants(state, action, episode)[episode])


def variants(state: np.ndarray, action: np.ndarray, episode: np.ndarray) -> np.ndarray:
    """Per episode its number among those of one recording, -1 for the first: they have the same rows."""
    seen: dict[bytes, int] = {}
    found = []
    for index in range(episode.max() + 1):
        key = state[episode == index].tobytes() + action[episode == index].tobytes()
        seen[key] = seen.get(key, -2) + 1
        found.append(seen[key])
    return np.array(found)


def chunks(action: np.ndarray, episode: np.ndarray, length: int) -> np.ndarray:
    """[n, length, 6]: the actions from each frame on; the last one is repeated at an episode's end."""
    last = np.searchsorted(episode, episode, side="right") - 1
    index = np.minimum(np.arange(len(action))[:, None] + np.arange(length), last[:, None])
    return action[index]


class Network(nn.Module):
    """Pictures [n, 3, h, w] 0..1 and states [n, 6] to actions [n, k, 6], all in their own units."""

    def __init__(self, chunk: int, width: int = 32, hidden: int = 256) -> None:
        """Statistics are set by `normalised_by`."""
        super().__init__()
        self.features = nn.Sequential(
            nn.Conv2d(3, 16, 5, stride=2, padding=2),
            nn.GroupNorm(GROUPS, 16),
            nn.ReLU(),
            nn.Conv2d(16, width, 3, stride=2, padding=1),
            nn.GroupNorm(GROUPS, width),
            nn.ReLU(),
            nn.Conv2d(width, width, 3, padding=1),
            nn.GroupNorm(GROUPS, width),
            nn.ReLU(),
            nn.Conv2d(width, width, 1),
        )
        self.head = nn.Sequential(
            nn.Linear(2 * width + 6, hidden),
            nn.ReLU(),
            nn.Linear(hidden, hidden),
            nn.ReLU(),
            nn.Linear(hidden, chunk * 6),
        )
        self.chunk = chunk
        self.state_mean, self.state_std, self.action_mean, self.action_std = (
            nn.Parameter(torch.ones(6), requires_grad=False) for _ in range(4)
        )

    def normalised_by(self, frames: Frames) -> None:
        """Takes over the statistics of a training set."""
        for name in ("state", "action"):
            values = torch.from_numpy(getattr(frames, name))
            getattr(self, f"{name}_mean").copy_(values.mean(0))
            getattr(self, f"{name}_std").copy_(values.std(0).clamp(min=1e-2))

    def normal(self, action: Tensor) -> Tensor:
        """Actions as the loss compares them."""
        return (action - self.action_mean) / self.action_std

    def forward(self, pictures: Tensor, state: Tensor) -> Tensor:
        """Actions."""
        maps = self.features(2 * pictures - 1)
        h, w = maps.shape[2:]
        weights = maps.flatten(2).softmax(-1).unflatten(2, (h, w))
        x = (weights.sum(2) * torch.linspace(-1, 1, w)).sum(-1)
        y = (weights.sum(3) * torch.linspace(-1, 1, h)).sum(-1)
        out = self.head(torch.cat([x, y, (state - self.state_mean) / self.state_std], 1))
        return out.unflatten(1, (self.chunk, 6)) * self.action_std + self.action_mean


def train(frames: Frames, row: Row, form: Form, seed: int) -> Network:
    """A network trained for `form.steps` gradient steps."""
    from lerobot.transforms import ImageTransforms, ImageTransformsConfig

    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    used = np.flatnonzero([row.keeps(variant) for variant in frames.variant])
    goals = torch.from_numpy(chunks(frames.action, frames.episode, form.chunk))
    pictures, state = torch.from_numpy(frames.pictures).permute(0, 3, 1, 2), torch.from_numpy(frames.state)
    network = Network(form.chunk)
    network.normalised_by(frames)
    transform = ImageTransforms(ImageTransformsConfig(enable=row.transforms))
    optimiser = torch.optim.AdamW(network.parameters(), RATE, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=form.steps, pct_start=0.05)
    begin = time.perf_counter()
    for step in range(form.steps):
        rows = torch.from_numpy(rng.choice(used, form.batch))
        seen = pictures[rows].float() / 255
        seen = torch.cat([transform(part) for part in seen.split(SAMPLES_PER_TRANSFORM)])
        loss = (network.normal(network(seen, state[rows])) - network.normal(goals[rows])).abs().mean()
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), LARGEST_GRADIENT)
        optimiser.step()
        schedule.step()
        if (step + 1) % 500 == 0:
            print(f"  step {step + 1}: loss {loss.item():.3f}, {time.perf_counter() - begin:.0f} s", flush=True)
    return network


class SmallPolicy:
    """What rollouts ask for actions."""

    def __init__(self, network: Network, form: Form) -> None:
        """A trained network."""
        self.network, self.size = network.eval(), (form.input_width, form.input_height)

    @torch.no_grad()
    def __call__(self, pictures: np.ndarray, state: np.ndarray) -> np.ndarray:
        """Actions [n, k, 6] for pictures [n, h, w, 3] and states [n, 6]."""
        small = np.stack([cv2.resize(picture, self.size, interpolation=cv2.INTER_AREA) for picture in pictures])
        inputs = torch.from_numpy(small).permute(0, 3, 1, 2).float() / 255
        return self.network(inputs, torch.from_numpy(state)).numpy()
