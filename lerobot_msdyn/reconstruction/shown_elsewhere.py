"""What other episodes show of what stands still before a camera that moves: it fills in what this episode never shows.

Each episode gives its key views, which are freed of what moves. An episode takes those of another if depths and colours
agree where both show the same surface; of these it leaves out what its own key views contradict (things that stood
elsewhere) and what is far outside of its own pictures. The rest takes part in its key views: pixels of these that it
never shows itself are filled, and further key views are put behind its own. What it shows itself stays as it is.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack, concatenated
from lerobot_msdyn.core.geometry import invert_se3
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.core.sampling import evenly, scaled_px, scaled_window
from lerobot_msdyn.core.visibility import projected
from lerobot_msdyn.priors.fused_frames import EXACT, Source, fused, tolerance_of, usual_difference
from lerobot_msdyn.reconstruction.align_poses import laid_over
from lerobot_msdyn.reconstruction.background import MARGIN_PX, EmptyScene, look_at_distance
from lerobot_msdyn.reconstruction.key_views import Fusing, KeyView, shown, with_further

logger = logging.getLogger(__name__)

MOST_SHOWN = 6  # key views that an episode gives: the first show most
MOST_FURTHER = 8  # key views behind an episode's own
REACH = 0.5  # of a picture's size, by which surfaces may lie beside it and still be wanted
REACHING = 8  # frames by which that is judged
LEAST_BOTH = 0.05  # share of a picture that two episodes must both show for them to be compared
# Share of it that must agree. On simulated desks, 320 px wide: 0.98 where both episodes are of one kind, 0.87 to 0.89
# where an arm rests in one alone; 0.91, 0.79 and 0.66 where poses are 3, 10 and 30 mm beside (0.4, 1.4 and 4 % of the
# distance) and are not refined; 0.20 to 0.66 where the desk is laid otherwise.
AGREEING = 0.83
# The same of depth that nobody measured, after what it is off by smoothly has been taken out: 0.83 to 0.89 by networks'
# depth of the same desk, 0.67 to 0.76 where poses are 30 mm beside, 0.43 to 0.47 where the desk is laid otherwise.
AGREEING_ROUGHLY = 0.78
ROUGH = 0.03  # relative difference up to which such depths are of one surface
BENT_OVER = 1 / 32  # of a picture's width, over which such depth is off alike ...
BENT_BY = (0.1, 0.05)  # ... and by how much at most, in two rounds
BENT_AS_USUAL = 0.02  # weight of what is usual, where little is in both
BLUR_PX = 1.5  # of 320: colours are compared after it, since fine texture lies half a pixel beside
ALIKE_GREY_LEVELS = 20.0  # difference up to which colours are alike, after the gain
GREY = (16, 240)  # grey levels between which a gain is told
GAINS = (0.5, 2.0)  # of one episode's brightness to another's; beyond them these are not of the same scene


@dataclass(frozen=True)
class Shown:
    """What an episode shows of what stands still."""

    episode: int
    rgb: UInt8[Tensor, "k h w 3"]
    depth: Float[Tensor, "k h w"]  # m; 0 = unknown
    camera: CameraTrack  # a pose for each

    @classmethod
    def of(cls, episode: int, keys: Sequence[KeyView]) -> "Shown":
        """By its key views."""
        given = keys[:MOST_SHOWN]
        depth = [key.empty.depth.masked_fill(key.empty.seen == 0, 0.0) for key in given]
        rgb = torch.stack([key.empty.rgb for key in given])
        return cls(episode, rgb, torch.stack(depth), concatenated([key.camera for key in given]))

    def fits(self, view: View) -> bool:
        """Whether a video was taken by a camera that moves, with poses in the same world."""
        return bool(view.camera.world) and view.camera.world == self.camera.world and not view.camera.is_static

    @property
    def sources(self) -> list[Source]:
        """As frames that are fused."""
        each = zip(self.rgb, self.depth, strict=True)
        return [Source.of(rgb.numpy(), depth, self.camera.select([i])) for i, (rgb, depth) in enumerate(each)]


@dataclass(frozen=True)
class _Laid:
    """A frame of another episode, and what this one's key views show of the same."""

    source: Source
    rgb: UInt8[ndarray, "h w 3"]  # of this episode
    same: Bool[ndarray, "h w"]  # both show the same surface
    other: Bool[ndarray, "h w"]  # one of them sees through what the other shows
    through: Bool[ndarray, "h w"]  # this episode sees through what the frame shows

    @classmethod
    def of(cls, source: Source, own: Sequence[Source], tolerance: float) -> "_Laid":
        """Lay a frame over key views."""
        mine = fused(source, own, tolerance, exact=False)
        sees, past = torch.zeros(2, len(source.points))
        for key in own:
            seen = projected(source.points, key.camera)
            sees += key.sees(seen, tolerance)
            past += key.sees_through(seen, tolerance)
        through = torch.zeros_like(source.depth, dtype=torch.bool)
        through[source.depth > 0] = past > sees
        both = (source.depth > 0) & (mine.seen > 0)
        same = both & ~through & ((mine.depth - source.depth).abs() < tolerance * source.depth)
        before = both & (mine.depth < (1 - tolerance) * source.depth)
        other = (before | through) & ~same
        return cls(source, mine.rgb.numpy(), same.numpy(), other.numpy(), through.numpy())

    def alike(self, gain: Float32[ndarray, "3"]) -> Bool[ndarray, "h w"]:
        """Where colours are alike, at a gain; only of use where both show the same."""
        weight = self.same.astype(np.float32)
        difference = (self.source.rgb * gain - self.rgb) * weight[..., None]
        sigma = scaled_px(BLUR_PX, weight.shape[1])
        blurred = cv2.GaussianBlur(difference, (0, 0), sigma) / cv2.GaussianBlur(weight, (0, 0), sigma)[..., None].clip(
            min=1e-3
        )
        return np.asarray(np.abs(blurred).max(-1) < ALIKE_GREY_LEVELS)


@dataclass(frozen=True)
class _Compared:
    """Another episode, held against this one."""

    other: Shown
    laid: list[_Laid]
    gain: Float32[ndarray, "3"]  # that brings its colours to this one's
    alike: list[Bool[ndarray, "h w"]]  # where both show the same surface in the same colour
    enough: float  # share that must agree

    @classmethod
    def of(cls, other: Shown, own: Sequence[Source], tolerance: float, *, measured: bool = True) -> "_Compared":
        """Hold it against key views; depth that nobody measured is brought to theirs first."""
        if not measured:
            for most in BENT_BY:
                other = _bent(other, own, most)
        laid = [_Laid.of(source, own, tolerance) for source in other.sources]
        gain, enough = _gain(laid), AGREEING if measured else AGREEING_ROUGHLY
        return cls(other, laid, gain, [frame.alike(gain) & frame.same for frame in laid], enough)

    @property
    def both(self) -> int:
        """Pixels of its frames of which both episodes say something."""
        return sum(int((frame.same | frame.other).sum()) for frame in self.laid)

    @property
    def share(self) -> float:
        """Of these, how many agree."""
        return sum(int(alike.sum()) for alike in self.alike) / max(self.both, 1)

    @property
    def accepted(self) -> bool:
        """Whether the two show the same scene, in the same frame."""
        if self.both < LEAST_BOTH * self.other.depth[0].numel():
            logger.info("background: nothing is taken of episode %d: too little is in both", self.other.episode)
            return False
        told = bool(((self.gain >= GAINS[0]) & (self.gain <= GAINS[1])).all())
        what = f"{100 * self.share:.1f} % of what is in both agrees, colours times {self.gain.round(2)}"
        if not told or self.share < self.enough:
            logger.info("background: nothing is taken of episode %d: %s", self.other.episode, what)
            return False
        logger.debug("background: episode %d: %s", self.other.episode, what)
        return True

    def taken(self, near: Sequence[CameraTrack]) -> list[Source]:
        """What is taken of it, in this episode's brightness."""
        sources = []
        for frame, alike in zip(self.laid, self.alike, strict=True):
            window = scaled_window(MARGIN_PX, alike.shape[1])
            against = cv2.dilate((frame.through | (frame.same & ~alike)).astype(np.uint8), window) > 0
            wanted = _within_reach(frame.source, near) & ~torch.from_numpy(against)
            if bool(wanted.any()):
                rgb = (frame.source.rgb * self.gain).round().clip(0, 255).astype(np.uint8)
                sources.append(Source.of(rgb, frame.source.depth * wanted, frame.source.camera))
        return sources


def with_shown(
    keys: Sequence[KeyView], view: View, elsewhere: Sequence[Shown], *, refine: bool = True, measured: bool = True
) -> tuple[KeyView, ...]:
    """An episode's key views, with what others show of surfaces that it does not show.

    Args:
        keys: its own.
        view: its video.
        elsewhere: what others show, with poses in the same world.
        refine: whether others are laid over this one, so that a small error of their poses goes.
        measured: whether depth is (`DepthTraits.measured`); a network's is off by something else in every video.
    """
    own = [key.source for key in keys]
    difference = usual_difference(own)
    tolerance = tolerance_of(difference) if measured else max(tolerance_of(difference), ROUGH)
    near = _reaching(keys, view.camera)
    taken: list[Source] = []
    for other in elsewhere:
        compared = _Compared.of(other, own, tolerance, measured=measured)
        if refine:
            moved = _Compared.of(_moved(compared, keys), own, tolerance, measured=measured)
            compared = max(compared, moved, key=lambda one: one.share)
        if compared.accepted:
            taken += compared.taken(near)
    if not taken:
        return tuple(keys)
    filled = _filled(keys, taken, tolerance)
    fusing = Fusing([*own, *taken], tolerance, exact=difference < EXACT)
    found = with_further(filled, taken, fusing, len(keys) + MOST_FURTHER)
    before, after = (sum(int((key.new & (key.empty.seen > 0)).sum()) for key in part) for part in (keys, found))
    logger.info(
        "background: %d surface elements and %d key views more by frames of other episodes",
        after - before,
        len(found) - len(keys),
    )
    return tuple(found)


def _moved(compared: "_Compared", keys: Sequence[KeyView]) -> Shown:
    """Another episode, all of it moved as its frame that has most in common goes where it is laid over this one."""
    other = compared.other
    most = int(np.argmax([int(frame.same.sum()) for frame in compared.laid]))
    one = View(other.rgb[most : most + 1], other.camera.select([most]))
    still = torch.zeros(1, *other.depth.shape[1:], dtype=torch.uint8)
    distance = look_at_distance(keys[0].empty.depth)
    camera, _ = laid_over(keys, one, other.depth[most : most + 1], still, distance)
    given = other.camera.world_from_camera.double()
    by = camera.world_from_camera[0].double() @ invert_se3(given[most])
    return replace(other, camera=replace(other.camera, world_from_camera=(by @ given).float()))


def _bent(other: Shown, own: Sequence[Source], most: float) -> Shown:
    """Another episode with its depth times a factor that varies smoothly, by which this one's key views differ from it.

    Where they differ by more than `most` (relative), they show something else.
    """
    depth = []
    for source in other.sources:
        mine = fused(source, own, most, exact=False).depth.numpy()
        theirs = source.depth.numpy()
        both = (mine > 0) & (theirs > 0)
        factor = np.log(np.where(both, mine, 1.0) / np.where(both, theirs, 1.0)).astype(np.float32)
        both &= np.abs(factor) < most
        weight = both.astype(np.float32)
        usual = float(np.median(factor[both])) if both.any() else 0.0
        sigma = BENT_OVER * weight.shape[1]
        total = cv2.GaussianBlur(factor * weight, (0, 0), sigma) + BENT_AS_USUAL * usual
        smooth = total / (cv2.GaussianBlur(weight, (0, 0), sigma) + BENT_AS_USUAL)
        depth.append(torch.from_numpy(theirs * np.exp(smooth)))
    return replace(other, depth=torch.stack(depth))


def _reaching(keys: Sequence[KeyView], camera: CameraTrack) -> list[CameraTrack]:
    """Places from which surfaces are wanted."""
    return [key.camera for key in keys] + [camera.select([i]) for i in evenly(len(camera), REACHING).tolist()]


def _gain(laid: Sequence[_Laid]) -> Float32[ndarray, "3"]:
    """By how much this episode is brighter than frames of another, per channel: the median over the same surfaces."""
    ratios = []
    for frame in laid:
        mine, theirs = (picture[frame.same].astype(np.float32) for picture in (frame.rgb, frame.source.rgb))
        usable = ((mine > GREY[0]) & (mine < GREY[1]) & (theirs > GREY[0]) & (theirs < GREY[1])).all(1)
        ratios.append(mine[usable] / theirs[usable])
    together = np.concatenate(ratios)
    return np.median(together, axis=0) if len(together) else np.ones(3, np.float32)


def _within_reach(source: Source, near: Sequence[CameraTrack]) -> Bool[Tensor, "h w"]:
    """Pixels whose surfaces lie in one of some cameras' pictures, or beside it."""
    reached = torch.zeros(len(source.points), dtype=torch.bool)
    for camera in near:
        seen = projected(source.points, camera)
        size = torch.tensor([camera.width, camera.height])
        reached |= (seen.z > 0) & ((seen.xy > -REACH * size) & (seen.xy < (1 + REACH) * size)).all(-1)
    within = torch.zeros_like(source.depth, dtype=torch.bool)
    within[source.depth > 0] = reached
    return within


def _filled(keys: Sequence[KeyView], sources: Sequence[Source], tolerance: float) -> list[KeyView]:
    """Key views in which other episodes' frames stand in for what was never seen."""
    filled = [*keys]
    for i, key in enumerate(keys):
        empty = key.empty
        theirs = fused(key.source, sources, tolerance, exact=False)
        take = (empty.seen == 0) & (theirs.seen > 0)
        if not bool(take.any()):
            continue
        completed = EmptyScene(
            torch.where(take[..., None], theirs.rgb, empty.rgb),
            torch.where(take, theirs.depth, empty.depth),
            torch.where(take, theirs.seen, empty.seen),
        )
        known = torch.cat([other.points for j, other in enumerate(filled) if j != i] or [torch.zeros(0, 3)])
        new = key.new | (take & ~shown(known, key.camera, completed.depth, tolerance))
        filled[i] = replace(key, empty=completed, new=new)
    return filled
