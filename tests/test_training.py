"""LeRobot's own trainer takes the output as it is."""

import subprocess
import sys
from pathlib import Path

import pytest

from lerobot_msdyn.episode import open_source, read_colour, read_rows
from lerobot_msdyn.provenance import Provenance
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.dataset import write_dataset
from lerobot_msdyn.write import NewEpisode, OutputDataset

FRONT = "observation.images.front"
SMALL_ACT = (
    "--policy.device=cpu",
    "--policy.pretrained_backbone_weights=null",
    "--policy.chunk_size=4",
    "--policy.n_action_steps=4",
    "--policy.dim_model=32",
    "--policy.n_heads=2",
    "--policy.dim_feedforward=32",
    "--policy.n_encoder_layers=1",
    "--policy.n_vae_encoder_layers=1",
    "--policy.latent_dim=4",
    "--batch_size=2",
    "--steps=2",
    "--num_workers=0",
    "--log_freq=1",
    "--save_checkpoint=false",
    "--wandb.enable=false",
    "--dataset.video_backend=pyav",
)


@pytest.mark.slow
def test_lerobot_train_takes_the_output(tmp_path: Path) -> None:
    write_dataset([make_scene("push", 0, 8, 64, 48)], "local/desk", tmp_path / "desk")  # ACT takes no depth images
    source = open_source("local/desk", tmp_path / "desk")
    root = tmp_path / "new"
    with OutputDataset(source, "local/new", root) as output:
        rgb = read_colour(source, 0, FRONT, read_rows(source, 0)).numpy()
        made = output.stage(0, 0, ({FRONT: frame} for frame in rgb), Provenance("local/desk", 0, 0, 0))
        output.finish([NewEpisode(0, Provenance("local/desk", 0, -1, 0)), made], "")
    done = subprocess.run(
        [
            str(Path(sys.executable).with_name("lerobot-train")),
            "--dataset.repo_id=local/new",
            f"--dataset.root={root}",
            "--policy.type=act",
            "--policy.push_to_hub=false",
            f"--output_dir={tmp_path / 'run'}",
            *SMALL_ACT,
        ],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert "End of training" in done.stderr + done.stdout
    assert "dataset.num_episodes=2" in done.stderr + done.stdout
