"""The training sets: what each row of the table trains on, as LeRobot datasets with pictures of one codec.

A further row is one entry of `ROWS`. Demonstrations (states of the simulator, from which exact pictures of any camera
follow) are kept outside the datasets: the product sees a recording of two cameras and nothing else.
"""

import copy
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from .cameras import Placement, intrinsics, product_pose, random_placement, table_homography
from .forms import Form
from .store import Store

if TYPE_CHECKING:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from .scene import Scene
    from .task import Demonstration

FRONT, WRIST = "observation.images.front", "observation.images.wrist"
RECORDED = "recorded"
WITHOUT_JOINTS = "--camera.by_robot=false"
WITH_JOINTS = ("--robot.name=so101",)
WITH_DEPTH = f"{RECORDED} with depth"
FITTED = "product with joints"  # whose scenes other rows are rendered from
ENDS = Path(__file__).with_name("ends.py")  # a plugin
Episode = tuple["Demonstration", Iterable[np.ndarray]]  # and the front pictures [h, w, 3] of its frames
DEPTH = f"{FRONT}_depth"


class Sets:
    """Makes the training sets that are asked for, once."""

    def __init__(self, store: Store, form: Form, workers: int, depth_network: Path | None = None) -> None:
        """Nothing is made before it is asked for.

        `workers` are those of the product's command, `depth_network` is a file of ONNX for rows with one.
        """
        self.store, self.form, self.workers, self.depth_network = store, form, workers, depth_network
        self.draw = 0
        self._scene: Scene | None = None

    def of_draw(self, draw: int) -> "Sets":
        """The same with other samples of the new cameras: which ones were drawn tells as much as who was trained."""
        other = copy.copy(self)
        other.draw = draw
        return other

    @property
    def scene(self) -> "Scene":
        """The simulated scene."""
        if self._scene is None:
            from .scene import Scene
            from .task import SCENE_XML

            self._scene = Scene(SCENE_XML, self.form)
        return self._scene

    def demonstrations(self) -> list["Demonstration"]:
        """The expert's episodes."""
        from .task import Demonstration, Task

        def make(path: Path) -> None:
            episodes = enumerate(Task().demonstrations(self.form.episodes))
            arrays: dict[str, Any] = {f"{name}_{i}": value for i, one in episodes for name, value in vars(one).items()}
            np.savez_compressed(path, **arrays)

        with np.load(self.store.made("demonstrations.npz", make)) as file:
            names = Demonstration.__dataclass_fields__
            return [Demonstration(**{name: file[f"{name}_{i}"] for name in names}) for i in range(self.form.episodes)]

    def folder(self, row: "Row") -> Path:
        """The dataset that a row trains on."""
        return self.store.made(f"sets/{self.name(row)}", lambda path: row.make(self, path))

    def name(self, row: "Row") -> str:
        """That of a row's dataset, in the store."""
        return f"{row.dataset}_draw_{self.draw}" if row.drawn and self.draw else row.dataset

    def write(self, root: Path, episodes: Iterable[Episode], *, wrist: bool = False, depth: bool = False) -> None:
        """Records episodes through LeRobot's own API; `depth` is that of the pictures as they are rendered."""
        from lerobot.configs import DepthEncoderConfig
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        from lerobot_msdyn.dataset.video import tamed_av1

        from .task import FPS, JOINTS, TASK

        picture = {
            "dtype": "video",
            "shape": (self.form.height, self.form.width, 3),
            "names": ["height", "width", "channels"],
        }
        vector = {"dtype": "float32", "shape": (len(JOINTS),), "names": [f"{name}.pos" for name in JOINTS]}
        features: dict[str, Any] = {"observation.state": vector, "action": dict(vector), FRONT: picture}
        if wrist:
            features[WRIST] = dict(picture)
        if depth:
            size = (self.form.height, self.form.width, 1)
            features[DEPTH] = picture | {"shape": size, "info": {"is_depth_map": True}}
        dataset = LeRobotDataset.create(
            "local/policy",
            FPS,
            features,
            root=root,
            robot_type="so101_follower",
            video_backend="pyav",
            depth_encoder=DepthEncoderConfig(extra_options={"x265-params": "lossless=1:log-level=error"}),
        )
        for demonstration, pictures in episodes:
            for t, front in enumerate(pictures):
                row = {"observation.state": demonstration.state[t], "action": demonstration.action[t], "task": TASK}
                if depth:
                    row[DEPTH] = self.scene.depth_mm()
                if wrist:
                    row[WRIST] = self.scene.pictures(demonstration.qpos[t], wrist=True)[0]
                dataset.add_frame(row | {FRONT: front})
            with tamed_av1():
                dataset.save_episode(parallel_encoding=False)
        dataset.finalize()

    def rendered(self, demonstration: "Demonstration", pose: np.ndarray) -> Iterator[np.ndarray]:
        """The exact pictures of an episode from a world-from-camera pose."""
        return (self.scene.pictures(qpos, pose)[0] for qpos in demonstration.qpos)

    def random_poses(self, episode: int) -> list[np.ndarray]:
        """The level poses of the oracle and of the homography."""
        key = [episode, 22, self.draw] if self.draw else [episode, 21]
        return self._poses(np.random.default_rng(key), self.form.variants)

    def frame_poses(self, episode: int, variant: int, count: int) -> list[np.ndarray]:
        """Level poses for single frames, of the same spread."""
        key = [episode, 22, self.draw, variant] if self.draw else [episode, 21, variant]
        return self._poses(np.random.default_rng(key), count)

    def _poses(self, rng: np.random.Generator, count: int) -> list[np.ndarray]:
        bounds = self.form.range_deg, self.form.range_deg / 3, self.form.range_m
        return [random_placement(rng, *bounds).world_from_camera() for _ in range(count)]


def recorded(sets: Sets, path: Path, *, depth: bool = False) -> None:
    """The demonstrations as they are recorded; only here, where the product copies it, is the wrist camera."""
    pose = Placement().world_from_camera()
    sets.write(path, ((one, sets.rendered(one, pose)) for one in sets.demonstrations()), wrist=True, depth=depth)


def oracle(sets: Sets, path: Path) -> None:
    """With each episode, exact pictures of it from random level poses."""
    poses = [[Placement().world_from_camera(), *sets.random_poses(i)] for i in range(sets.form.episodes)]
    _write_rendered(sets, path, poses)


def oracle_per_frame(sets: Sets, path: Path) -> None:
    """As `oracle`, with a random pose for every frame."""

    def episodes() -> Iterator[Episode]:
        for index, one in enumerate(sets.demonstrations()):
            yield one, sets.rendered(one, Placement().world_from_camera())
            for variant in range(sets.form.variants):
                poses = sets.frame_poses(index, variant, len(one.qpos))
                yield one, (sets.scene.pictures(*state)[0] for state in zip(one.qpos, poses, strict=True))

    sets.write(path, episodes())


def _write_rendered(sets: Sets, path: Path, poses: list[list[np.ndarray]]) -> None:
    demonstrations = sets.demonstrations()
    sets.write(path, ((one, sets.rendered(one, p)) for one, of in zip(demonstrations, poses, strict=True) for p in of))


def homography(sets: Sets, path: Path) -> None:
    """With each episode, its recorded pictures warped to the oracle's poses as if all lay on the table."""
    source = opened(sets.folder(ROWS[RECORDED]))
    form, K, base = sets.form, intrinsics(sets.form.width, sets.form.height), Placement().world_from_camera()

    def episodes() -> Iterator[Episode]:
        for index, one in enumerate(sets.demonstrations()):
            frames = front_pictures(source, index)
            yield one, sets.rendered(one, base)
            for pose in sets.random_poses(index):
                H = table_homography(base, pose, K)
                size, mode = (form.width, form.height), cv2.BORDER_REPLICATE
                yield one, [cv2.warpPerspective(frame, H, size, borderMode=mode) for frame in frames]

    sets.write(path, episodes())


def opened(root: Path) -> "LeRobotDataset":
    """A training set."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset("local/policy", root=root, video_backend="pyav")


def front_pictures(dataset: "LeRobotDataset", episode: int) -> list[np.ndarray]:
    """The front camera's decoded pictures [h, w, 3] of an episode."""
    from lerobot.datasets.video_utils import decode_video_frames

    row = dataset.meta.episodes[episode]
    times = row[f"videos/{FRONT}/from_timestamp"] + np.arange(row["length"]) / dataset.fps
    path = dataset.root / dataset.meta.get_video_file_path(episode, FRONT)
    decoded = decode_video_frames(path, times.tolist(), dataset.tolerance_s, "pyav", return_uint8=True)
    return list(decoded.permute(0, 2, 3, 1).numpy())


def product(
    sets: Sets,
    path: Path,
    flags: tuple[str, ...] = (WITHOUT_JOINTS,),
    *,
    scenes_of: str = "",
    first_draw: str = "",
    of: str = RECORDED,
    network: bool = False,
) -> None:
    """What the package's command makes of the recording, with its defaults but for the given flags.

    Args:
        sets: all of them.
        path: where it goes.
        flags: of the command.
        scenes_of: a row whose scenes are rendered; else they are fitted.
        first_draw: the row itself, whose first draw's scenes are rendered in all others.
        of: the row that is the recording.
        network: whether depth is the network's.
    """
    source = sets.folder(ROWS[of])
    given = [f"--root={source}", f"--new_root={path}", "--new_repo_id=local/policy_msdyn", "--repo=local/policy"]
    given += [f"--variants={sets.form.variants}", f"--workers={sets.workers}"]
    if sets.draw:
        given += [f"--seed={sets.draw}"]
        scenes_of = scenes_of or first_draw
    if scenes_of:
        given += [f"--scenes={sets.of_draw(0).folder(ROWS[scenes_of])}"]
    else:
        given += ["--save_scenes=true"]
    if network:
        given += [f"--priors.depth=onnx:{sets.depth_network}"]
    command = [sys.executable, "-m", "lerobot_msdyn.augment", *given]
    environment = os.environ | {"LEROBOT_MSDYN_CACHE": str(sets.store.root / "priors"), "HF_HUB_OFFLINE": "1"}
    log = sets.store.root / "augment.log"
    with log.open("a") as file:
        done = subprocess.run([*command, *sets.form.product, *flags], env=environment, stdout=file, stderr=file)
    if done.returncode not in (0, 1) or not path.exists():  # 1: some views were rejected, which is part of the product
        sys.exit(f"augment ended with {done.returncode}; {log} says why")


def oracle_at_poses_of(name: str, sets: Sets, path: Path) -> None:
    """With each episode, exact pictures of it from the poses that a row of the product chose."""
    from lerobot_msdyn.dataset.provenance import read_provenance

    base = Placement().world_from_camera()
    poses: list[list[np.ndarray]] = [[base] for _ in range(sets.form.episodes)]
    for episode in read_provenance(sets.folder(ROWS[name])) or []:
        if episode["variant"] >= 0:
            view, amounts = (json.loads(episode[column])[FRONT] for column in ("views", "perturbation"))
            poses[episode["source_episode"]].append(product_pose(view, amounts))
    _write_rendered(sets, path, poses)


@dataclass(frozen=True)
class Row:
    """One way to train: a dataset, and how it is used."""

    dataset: str
    make: Callable[[Sets, Path], None]
    transforms: bool = True  # LeRobot's image transforms
    variants: int | None = None  # new episodes per recorded one that are used; None: all
    source: bool = True  # whether the recorded episodes are used
    drawn: bool = True  # whether it has new cameras, which differ from draw to draw
    network: bool = False  # whether it needs a depth network

    def keeps(self, variant: int) -> bool:
        """Whether an episode is used, by its number among those of one recording; -1 is the recording."""
        return self.source if variant < 0 else self.variants is None or variant < self.variants


def _fitted(name: str, dataset: str, flags: tuple[str, ...], *, of: str = RECORDED, network: bool = False) -> Row:
    return Row(dataset, partial(product, flags=flags, first_draw=name, of=of, network=network), network=network)


_NETWORK, _DEPTH = f"{FITTED} and a depth network", f"{FITTED} and recorded depth"
ROWS: dict[str, Row] = {
    RECORDED: Row(RECORDED, recorded, transforms=False, drawn=False),
    WITH_DEPTH: Row("recorded_depth", partial(recorded, depth=True), transforms=False, drawn=False),
    "transforms": Row(RECORDED, recorded, drawn=False),
    "oracle": Row("oracle", oracle),
    "homography": Row("homography", homography),
    "product": _fitted("product", "product", (WITHOUT_JOINTS,)),
    FITTED: _fitted(FITTED, "product_joints", WITH_JOINTS),
    _NETWORK: _fitted(_NETWORK, "product_network", WITH_JOINTS, network=True),
    _DEPTH: _fitted(_DEPTH, "product_depth", WITH_JOINTS, of=WITH_DEPTH),
    "oracle at the product's poses": Row("oracle_product", partial(oracle_at_poses_of, "product")),
    f"oracle at the poses of {FITTED}": Row("oracle_product_joints", partial(oracle_at_poses_of, FITTED)),
}
USUAL = ("transforms", "oracle", "homography", "product", FITTED, _NETWORK, _DEPTH)  # which fit two hours


def _changed(name: str, *flags: str) -> Row:
    """The product with joints, with some flags changed; nothing is fitted again."""
    return Row(f"product_joints_{name}", partial(product, flags=flags, scenes_of=FITTED))


def _swept(name: str, field: str, values: Iterable[Any]) -> dict[str, Row]:
    return {f"{name} {value}": _changed(f"{name}_{value}", f"--{field}={value}") for value in values}


_many = _changed("variants_10", "--variants=10")  # whose first n are those of n


SWEEPS: dict[str, dict[str, Row]] = {
    "range": {
        "product": ROWS["product"],
        "product within 15": Row(
            "product_15", partial(product, flags=("--perturbation.azimuth_deg=15",), scenes_of="product")
        ),
        FITTED: ROWS[FITTED],
    }
    | _swept("within", "perturbation.azimuth_deg", (5, 10, 20, 30)),
    "sampling": {
        "oracle, one pose per frame": Row("oracle_per_frame", oracle_per_frame),
        "one pose per frame": _changed("per_frame", "--perturbation.per_frame=true"),
        "towards the ends": _changed("ends", f"--plugins={ENDS}", "--perturbation.type=ends"),
        "without the recorded episodes": replace(_many, variants=2, source=False),
    },
    "variants": {f"variants {n}": replace(_many, variants=n) for n in (1, 2, 3, 6, 10)},
    "max_unseen": _swept("max_unseen", "max_unseen", (0.05, 0.1, 0.4, 1.0)),
    "fill": _swept("fill", "fill", ("nearest", "blur", "noise", "none"))
    | {"crop": _changed("crop", "--crop_to_covered=true")},
    "gate": _swept("min_expected_db", "gate.min_expected_db", (0, 22, 26)),
}
