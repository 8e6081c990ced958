"""A small ACT, trained by an unmodified `lerobot-train`."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import torch

from .forms import Form
from .sets import FRONT, Row

FEATURES = {
    "observation.state": {"type": "STATE", "shape": [6]},
    FRONT: {"type": "VISUAL", "shape": [3, 0, 0]},
}


def flags(folder: Path, row: Row, variants: list[int], form: Form, seed: int, out: Path) -> list[str]:
    """The command's flags; `variants` has each episode's number among those of one recording."""
    features = FEATURES | {FRONT: {"type": "VISUAL", "shape": [3, form.height, form.width]}}
    used = [episode for episode, variant in enumerate(variants) if row.keeps(variant)]
    device = "cuda" if torch.cuda.is_available() else "cpu"
    return [
        "--dataset.repo_id=local/policy",
        f"--dataset.root={folder}",
        f"--dataset.episodes={used}",
        f"--dataset.image_transforms.enable={str(row.transforms).lower()}",
        "--dataset.video_backend=pyav",
        "--policy.type=act",
        f"--policy.device={device}",
        f"--policy.input_features={json.dumps(features)}",
        "--policy.pretrained_backbone_weights=null",
        f"--policy.chunk_size={form.chunk}",
        f"--policy.n_action_steps={form.execute}",
        "--policy.dim_model=128",
        "--policy.n_heads=4",
        "--policy.dim_feedforward=512",
        "--policy.n_encoder_layers=2",
        "--policy.optimizer_lr=1e-4",
        "--policy.optimizer_lr_backbone=1e-4",
        "--policy.push_to_hub=false",
        f"--output_dir={out}",
        f"--batch_size={form.act_batch}",
        f"--steps={form.act_steps}",
        f"--save_freq={max(1, form.act_steps // 10)}",
        f"--seed={seed}",
        "--num_workers=1",
        "--wandb.enable=false",
    ]


def train(folder: Path, row: Row, variants: list[int], form: Form, seed: int, out: Path) -> None:
    """Trains, or goes on from the last checkpoint."""
    last = out / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
    train_script = [sys.executable, "-m", "lerobot.scripts.lerobot_train"]
    if last.exists():
        command = [*train_script, f"--config_path={last}", "--resume=true"]
    else:
        shutil.rmtree(out, ignore_errors=True)  # LeRobot refuses a folder that is there
        command = [*train_script, *flags(folder, row, variants, form, seed, out)]
    log = out.with_suffix(".log")
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as file:
        done = subprocess.run(command, stdout=file, stderr=file)
    if done.returncode:
        sys.exit(f"lerobot-train ended with {done.returncode}; {log} says why")


class ActPolicy:
    """What rollouts ask for actions."""

    def __init__(self, out: Path) -> None:
        """The last checkpoint of a training."""
        from lerobot.policies.act.modeling_act import ACTPolicy
        from lerobot.policies.factory import make_pre_post_processors

        path = str(out / "checkpoints" / "last" / "pretrained_model")
        self.policy = ACTPolicy.from_pretrained(path).eval()
        self.before, self.after = make_pre_post_processors(self.policy.config, pretrained_path=path)

    @torch.no_grad()
    def __call__(self, pictures: np.ndarray, state: np.ndarray) -> np.ndarray:
        """Actions [n, k, 6] for pictures [n, h, w, 3] and states [n, 6]."""
        batch = {
            FRONT: torch.from_numpy(pictures).permute(0, 3, 1, 2).float() / 255,
            "observation.state": torch.from_numpy(state),
        }
        actions: np.ndarray = self.after(self.policy.predict_action_chunk(self.before(batch))).numpy()
        return actions
