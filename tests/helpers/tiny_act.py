"""Flags that keep a training run of LeRobot's ACT short and offline."""

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
