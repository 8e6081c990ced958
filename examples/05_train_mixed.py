"""Train a small policy with MixedViews: half of its samples are seen from cameras that never stood there.

python examples/05_train_mixed.py [--frames 60] [--steps 500] [--updates 20]
"""

import argparse
import os
from pathlib import Path

import torch
from lerobot.configs import FeatureType
from lerobot.datasets import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.utils.feature_utils import dataset_to_policy_features

from lerobot_msdyn.augment import __main__ as augment
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.dataset import write_dataset
from lerobot_msdyn.training import MixedViews

SMALL = {"dim_model": 32, "n_heads": 2, "dim_feedforward": 32, "n_encoder_layers": 1, "n_vae_encoder_layers": 1}


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("example_out/train_mixed"))
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--steps", type=int, default=500, help="of the fit")
    parser.add_argument("--updates", type=int, default=20, help="of the policy")
    arguments = parser.parse_args()
    os.environ.setdefault("HF_HUB_OFFLINE", "1")

    root, scenes = arguments.out / "desk", arguments.out / "desk_msdyn"
    write_dataset([make_scene("push", 0, arguments.frames, 160, 120)], "local/desk", root)
    # variants are written as well; with MixedViews one is enough, to be looked at
    flags = {"repo": "local/desk", "root": root, "variants": 1, "save_scenes": "true", "fit.steps": arguments.steps}
    augment.run([f"--{name}={value}" for name, value in flags.items()])

    chunk = 4
    dataset = LeRobotDataset(
        "local/desk", root=root, video_backend="pyav", delta_timestamps={"action": [i / 30 for i in range(chunk)]}
    )
    mixed = MixedViews(dataset, scenes, probability=0.5)
    features = dataset_to_policy_features(dataset.meta.features)
    actions = {key: feature for key, feature in features.items() if feature.type is FeatureType.ACTION}
    config = ACTConfig(
        input_features={key: feature for key, feature in features.items() if key not in actions},
        output_features=actions,
        device="cpu",
        chunk_size=chunk,
        n_action_steps=chunk,
        pretrained_backbone_weights=None,
        **SMALL,
    )
    policy = ACTPolicy(config)
    optimizer = torch.optim.AdamW(policy.parameters(), lr=1e-4)
    batches = torch.utils.data.DataLoader(mixed, batch_size=4, shuffle=True, drop_last=True)
    done, epoch = 0, 0
    while done < arguments.updates:
        mixed.set_epoch(epoch)  # other views in every epoch
        for batch in batches:
            loss, _ = policy.forward(batch)
            loss.backward()
            optimizer.step()
            optimizer.zero_grad()
            done += 1
        epoch += 1
    print(f"{done} updates, {epoch} epochs, loss {float(loss):.3f}")


if __name__ == "__main__":
    main()
