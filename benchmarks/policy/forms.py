"""The sizes of the study: the full one, one that fits two hours on two cores, and a tiny one for tests."""

from dataclasses import dataclass

from .cameras import CAMERAS

FEW = (
    "recorded",
    *(f"azimuth {sign}{size}" for size in (10, 15) for sign in "-+"),
    *(f"{side} 5 cm" for side in ("left", "right", "up", "down")),
)


@dataclass(frozen=True)
class Form:
    """What the study's figures depend on."""

    episodes: int = 50
    width: int = 320  # px, recorded
    height: int = 240
    mesh_cell_m: float = 0.0  # vertices of meshes are merged within such cells; 0: as they come
    shadows: int = 1024  # px of the shadow map; 0: none
    samples: int = 4  # per pixel
    cluttered: bool = False  # whether boxes, a bottle and a wall stand about the workspace
    variants: int = 2  # new episodes per recorded one, in every row; the product's default
    range_deg: float = 15.0  # of the oracle's and the homography's random level poses ...
    range_m: float = 0.05  # ... and shifts
    product: tuple[str, ...] = ()  # flags of augment, for all of its rows
    cameras: tuple[str, ...] = tuple(CAMERAS)
    tasks: int = 40
    seeds: int = 3
    steps: int = 6000  # gradient steps of the small network
    batch: int = 32
    input_width: int = 128  # px, of the small network
    chunk: int = 16  # actions that are predicted ...
    execute: int = 8  # ... and of these executed before the next picture
    limit: int = 64  # control steps of an attempt, 10 per second
    act_steps: int = 20000
    act_batch: int = 8

    @property
    def input_height(self) -> int:
        """Px, of the small network."""
        return self.input_width * self.height // self.width


FORMS = {
    "full": Form(),
    "reduced": Form(
        mesh_cell_m=0.004,
        shadows=0,
        samples=0,
        product=(
            "--fit.steps=100",
            "--fit.max_width=160",
            "--scene.moving_gaussians=12000",
            "--scene.moving_frames=12",
        ),
        cameras=FEW,
        tasks=160,
        seeds=2,
        steps=15000,
        input_width=96,
        act_steps=2000,
    ),
    "tiny": Form(
        episodes=2,
        width=64,
        height=48,
        mesh_cell_m=0.008,
        shadows=0,
        samples=0,
        variants=1,
        product=("--fit.steps=4", "--scene.moving_gaussians=300", "--scene.moving_frames=3", "--gate.enabled=false"),
        cameras=("recorded", "azimuth +10"),
        tasks=2,
        seeds=1,
        steps=3,
        batch=4,
        input_width=32,
        limit=8,
        act_steps=2,
        act_batch=2,
    ),
}
