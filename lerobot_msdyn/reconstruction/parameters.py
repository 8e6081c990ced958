"""What a fit changes: tensors that Adam steps, and the scene that they make."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lerobot_msdyn.core.config import FitConfig
from lerobot_msdyn.motion.model.bases import MotionLevel
from lerobot_msdyn.motion.model.compose import Level
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.gaussians import Gaussians
from lerobot_msdyn.scene.shading import Shading

FINAL_RATE = 0.1  # the learning rates decay exponentially to this share
SETS = ("static", "moving")


@dataclass(frozen=True)
class Resampled:
    """A set of Gaussians that takes the place of another one."""

    gaussians: Gaussians
    rows: Int[Tensor, " g"]  # the Gaussian that each comes from, whose bases, weights and brightness it has
    fresh: Bool[Tensor, " g"]  # whether it is a new one, of which Adam remembers nothing


class Parameters:
    """The tensors of a scene that are optimised, by name, and Adam over them with a rate for each.

    `static.means`, ..., `moving.sh`: the Gaussians. `turns.0`, `shifts.0`, ... per level of bases: corrections of the
    motion that was estimated, scaled per basis by its doubt; none at the canonical frame, where all bases are the
    identity, nor for inactive bases. `weights.0`, ...: logits of the bases that each moving Gaussian follows.
    """

    def __init__(
        self,
        scene: DynamicScene,
        config: FitConfig,
        distance: float,
        doubt: Sequence[Float[Tensor, " _"]] = (),
        learned: Sequence[dict[str, Any]] = (),
    ) -> None:
        """All leaves of a scene.

        Args:
            scene: it is not changed.
            config: rates, and what is learned.
            distance: to the look-at point, m.
            doubt: per level the share of its rate at which each basis is learned; without, 1.
            learned: further groups of parameters for Adam.
        """
        self._given = scene
        self._leaves: dict[str, Tensor] = {}
        self._shares: dict[int, Float[Tensor, "k s 1"]] = {}
        rates = config.learning_rates
        rate = {
            "means": rates.means * distance,
            "quats": rates.quats,
            "log_scales": rates.log_scales,
            "opacity_logits": rates.opacity_logits,
            "sh": rates.colours,
        }
        by_name: dict[str, float] = {}
        for part in SETS:
            for name, lr in rate.items():
                self._leaves[f"{part}.{name}"] = getattr(getattr(scene, part), name).clone().requires_grad_()
                by_name[f"{part}.{name}"] = lr
        for i, level in enumerate(scene.levels):
            if config.learn.bases and isinstance(level, MotionLevel):
                self._shares[i] = _shares(level, scene.canonical_frame, doubt[i] if doubt else None)
                self._leaves[f"turns.{i}"] = torch.zeros_like(level.rotations_6d)
                self._leaves[f"shifts.{i}"] = torch.zeros_like(level.displacements)
                by_name |= {f"turns.{i}": rates.basis_turns, f"shifts.{i}": rates.basis_shifts * distance}
            if config.learn.weights and scene.logits[i].shape[1] > 1:
                self._leaves[f"weights.{i}"] = scene.logits[i].clone()
                by_name[f"weights.{i}"] = rates.motion_weights
        groups = [{"params": [self._leaves[name]], "lr": lr, "name": name} for name, lr in by_name.items()]
        self._adam = torch.optim.Adam(groups, eps=1e-15, fused=True)
        for group in learned:
            self._adam.add_param_group(group)
        self._decay = torch.optim.lr_scheduler.ExponentialLR(self._adam, FINAL_RATE ** (1 / max(config.steps, 1)))

    @property
    def scene(self) -> DynamicScene:
        """The scene of the tensors as they are, with gradients."""
        static, moving = (
            Gaussians(**{item.name: self._leaves[f"{part}.{item.name}"] for item in fields(Gaussians)}) for part in SETS
        )
        scene = replace(self._given, static=static, moving=moving)
        if self._learns_motion:
            levels = tuple(self._level(i, level) for i, level in enumerate(scene.levels))
            logits = tuple(self._leaves.get(f"weights.{i}", given) for i, given in enumerate(scene.logits))
            scene = replace(scene, levels=levels, logits=logits)
        return scene

    def result(self) -> DynamicScene:
        """The scene of the tensors as they are, without gradients."""
        with torch.no_grad():
            scene = self.scene
        static, moving = (
            Gaussians(**{item.name: getattr(part, item.name).detach() for item in fields(part)})
            for part in (scene.static, scene.moving)
        )
        if self._learns_motion:
            scene = replace(scene, logits=tuple(logit.detach() for logit in scene.logits))
        return replace(scene, static=static, moving=moving)

    def begin_motion(self) -> None:
        """From now on what there is of the motion takes part."""
        for name, leaf in self._leaves.items():
            if not name.startswith(SETS):
                leaf.requires_grad_()

    def shade(self, shading: Shading) -> None:
        """From now on the scene has this brightness."""
        self._given = replace(self._given, shading=shading)

    def step(self, loss: Float[Tensor, ""] | None) -> None:
        """One step of Adam down a loss; without one, only the rates decay."""
        self._adam.zero_grad(set_to_none=True)
        if loss is not None:
            loss.backward()
        self._adam.step()
        self._decay.step()

    def resample(self, part: str, new: Resampled) -> None:
        """Exchange a set, `static` or `moving`; bases, weights, brightness and Adam's memory follow its Gaussians."""
        select = self._given.select_static if part == "static" else self._given.select_moving
        self._given = select(new.rows)
        for item in fields(Gaussians):
            self._exchange(f"{part}.{item.name}", getattr(new.gaussians, item.name), new.rows, new.fresh)
        if part == "moving":
            for i, _ in enumerate(self._given.logits):
                if f"weights.{i}" in self._leaves:
                    self._exchange(f"weights.{i}", self._leaves[f"weights.{i}"][new.rows], new.rows, new.fresh)

    def reset(self, name: str, values: Tensor) -> None:
        """Give a leaf other values, of the same shape; Adam forgets what it knew of it."""
        rows = torch.arange(len(values), device=values.device)
        self._exchange(name, values, rows, torch.ones_like(rows, dtype=torch.bool))

    @property
    def _learns_motion(self) -> bool:
        return any(not name.startswith(SETS) for name in self._leaves)

    def _level(self, i: int, level: Level) -> Level:
        if i not in self._shares:
            return level
        assert isinstance(level, MotionLevel)
        return replace(
            level,
            rotations_6d=level.rotations_6d + self._shares[i] * self._leaves[f"turns.{i}"],
            displacements=level.displacements + self._shares[i] * self._leaves[f"shifts.{i}"],
        )

    def _exchange(self, name: str, values: Tensor, rows: Int[Tensor, " g"], fresh: Bool[Tensor, " g"]) -> None:
        """A leaf for another one, whose rows come from rows of the old one; of fresh ones nothing is remembered."""
        old = self._leaves[name]
        leaf = values.detach().clone().requires_grad_(old.requires_grad)
        self._leaves[name] = leaf
        group = next(group for group in self._adam.param_groups if group.get("name") == name)
        group["params"] = [leaf]
        memory = self._adam.state.pop(old, {})
        for key, value in memory.items():
            if value.shape == old.shape and value.dim() > 0:
                memory[key] = value[rows].masked_fill(fresh.reshape(-1, *[1] * (value.dim() - 1)), 0.0)
        if memory:
            self._adam.state[leaf] = memory


def _shares(level: MotionLevel, canonical_frame: int, doubt: Float[Tensor, " _"] | None) -> Float[Tensor, "k s 1"]:
    """By how much each correction counts: not at the canonical frame, nor for inactive bases."""
    free = (level.knots != canonical_frame).to(level.displacements)
    shares = level.active.to(free)[:, None] * free
    return (shares if doubt is None else shares * doubt.to(shares)[:, None])[..., None]
