"""What a robot's joints say of masks and depth goes before what others do, in the robot's pixels."""

from dataclasses import replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.observations import RobotSeen
from lerobot_msdyn.core.sampling import scaled_px
from lerobot_msdyn.priors.masks.before_links import shown_before
from lerobot_msdyn.priors.registry import Depth, Masks

RELATIVE_ERROR = 0.03  # of depth by a calibrated robot
BESIDE_PX = 4.0  # of 320: so far from the robot's pixels a mask may still be the robot's
SAME_DEPTH = 0.05  # share by which a thing and the link that touches it may differ
BEFORE = 0.08  # share by which a link must be nearer than a thing that rests, to be before it and not to touch it
TOUCHING_PX = 1.5  # of 320: no farther apart are things that touch
LEAST_TOUCHED = 8  # pixels
MOVED = 0.1  # share of a thing's pixels that are outside of where it was, if it has moved
LEAST_PX = 6.0  # of 320: side of the smallest thing that touches the robot


def with_robot(instances: Masks, robot: RobotSeen, rgb: UInt8[Tensor, "t h w 3"]) -> tuple[Masks, int]:
    """Instances of which one is the robot, and its id (0 where none of it moves).

    All pixels of moving links are its, but for those that show by their colours what it holds before them. It is the
    instance that covers most of them; what else that instance covers, farther from the robot than masks err, is another
    thing that touches the robot: the one that covers the same pixels in the frame before or after, else one of its own.
    """
    moving = robot.moving
    if not bool(moving.any()):
        return instances, 0
    shares = torch.bincount(instances[moving].long(), minlength=2)
    shares[0] = 0
    label = int(shares.argmax()) if bool(shares.any()) else min(int(instances.max()) + 1, 255)
    its = instances == label
    others = torch.from_numpy(_others(torch.where(its, 0, instances).numpy(), _touching(its, robot), label))
    things = torch.from_numpy(shown_before(rgb.numpy(), moving.numpy(), others.numpy()))
    own = (things == 0) & (moving | (its & (robot.depth == 0)))  # links that rest are not among what moves
    return torch.where(own, torch.tensor(label, dtype=torch.uint8), things), label


def with_robot_depth(depth: Depth, instances: Masks, robot: RobotSeen, label: int) -> Depth:
    """Depth with the robot's, unless a sensor measured it.

    What else of the robot's mask lies beside its pixels has the depth of the nearest of them. Another instance that
    touches a link that moves is as far away as that link where they touch, since it may be held above the table; one
    that lies on the ground stays there, and so does one behind the robot that is where it was without.

    Args:
        depth: by others.
        instances: with the robot, as `with_robot` gives them.
        robot: by its joints.
        label: the robot's instance id; 0: none of it moves.
    """
    if depth.traits.metric and depth.traits.measured:
        return depth
    z, resting = [], _resting(instances, robot.moving & (instances == label))
    lying = torch.tensor(sorted(depth.lying), dtype=torch.uint8)
    for known, ids, moving, other, rests in zip(robot.depth, instances, robot.moving, depth.z, resting, strict=True):
        its = (ids == label) & (ids > 0)
        own = _spread(known, its)
        free = torch.where(its | torch.isin(ids, lying), 0, ids)
        held = _held(free, torch.where(moving, known, 0.0), other, rests)
        z.append(torch.where(own > 0, own, held))
    return replace(depth, z=torch.stack(z))


def _resting(instances: Masks, links: Bool[Tensor, "t h w"]) -> Bool[Tensor, "t h w"]:
    """Pixels of things that are where they were in the last or the next frame in which no link touched them.

    In a frame before and after that frame none must have touched them either: masks of what is held can miss a link.
    """
    resting = torch.zeros_like(links)
    beside = torch.stack([with_touching(one) for one in links])
    for index in instances.unique().tolist():
        its = instances == index
        if not index or bool((its & links).any()):  # the robot
            continue
        size = its.sum((1, 2))
        free = (size > 0) & ((its & beside).sum((1, 2)) < LEAST_TOUCHED)
        alone = (free & torch.cat((free[:1], free[:-1])) & torch.cat((free[1:], free[-1:]))).nonzero()[:, 0]
        for t in size.nonzero()[:, 0].tolist():
            for other in (*alone[alone <= t][-1:].tolist(), *alone[alone >= t][:1].tolist()):
                moved = its[t] & ~with_touching(its[other])
                if moved.sum() <= MOVED * size[t]:
                    resting[t] |= its[t]
    return resting


def _held(
    others: UInt8[Tensor, "h w"], links: Float[Tensor, "h w"], depth: Float[Tensor, "h w"], rests: Bool[Tensor, "h w"]
) -> Float[Tensor, "h w"]:
    """Depth (m) in which instances that touch links (m, 0 = none) are as far away as these where they touch them.

    What is about as far away already stays where it is: it may stand on the table. So does what rests far behind.
    """
    for index in others.unique().tolist():
        its = others == index
        touched = links[with_touching(its) & (links > 0)]
        if not index or len(touched) < LEAST_TOUCHED:
            continue
        beside = with_touching(links > 0) & its & (depth > 0)
        if not bool(beside.any()):
            depth = torch.where(its, touched.median(), depth)
            continue
        factor = touched.median() / depth[beside].median()
        behind = -float(factor.log())
        if abs(behind) > SAME_DEPTH and not (behind > BEFORE and bool(rests[its].any())):
            depth = torch.where(its, factor * depth, depth)
    return depth


def with_touching(mask: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """A mask, and the pixels that are close enough for what they show to touch it."""
    window = np.ones((2 * max(1, round(scaled_px(TOUCHING_PX, mask.shape[1]))) + 1,) * 2, np.uint8)
    return torch.from_numpy(cv2.dilate(mask.numpy().astype(np.uint8), window) > 0)


def _spread(depth: Float[Tensor, "h w"], mask: Bool[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Depth (0 = unknown) with that of the nearest known pixel wherever a mask is."""
    unknown = (depth <= 0).numpy()
    if unknown.all():
        return depth
    _, nearest = cv2.distanceTransformWithLabels(
        unknown.astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.zeros(int(nearest.max()) + 1, np.float32)
    of_label[nearest[~unknown]] = depth.numpy()[~unknown]
    return torch.where(mask & (depth <= 0), torch.from_numpy(of_label[nearest]), depth)


def _touching(its: Bool[Tensor, "t h w"], robot: RobotSeen) -> Bool[ndarray, "t h w"]:
    """Those of its pixels that are too far from the robot, and too many at once, to be an error."""
    width = its.shape[2]
    grown = np.ones((2 * round(scaled_px(BESIDE_PX, width)) + 1,) * 2, np.uint8)
    least = np.ones((max(2, round(scaled_px(LEAST_PX, width))),) * 2, np.uint8)
    found = []
    for mask, depth in zip(its.numpy(), robot.depth.numpy(), strict=True):
        away = mask & (cv2.dilate((depth > 0).astype(np.uint8), grown) == 0)
        core = cv2.morphologyEx(away.astype(np.uint8), cv2.MORPH_OPEN, least)
        beside = mask & (depth == 0)
        _, pieces = cv2.connectedComponents(beside.astype(np.uint8))
        found.append(np.isin(pieces, np.unique(pieces[core > 0])) & beside)
    return np.stack(found)


def _others(labels: UInt8[ndarray, "t h w"], touching: Bool[ndarray, "t h w"], robot: int) -> UInt8[ndarray, "t h w"]:
    """Instances but the robot, with what touches it: each piece has the id of what it covers in a frame beside it."""
    labels = labels.copy()
    new = min(max(int(labels.max()), robot) + 1, 255)
    for frames in (range(1, len(labels)), range(len(labels) - 2, -1, -1)):
        step = frames.step
        for frame in frames:
            _adopt(labels[frame], touching[frame] & (labels[frame] == 0), labels[frame - step])
    left = touching & (labels == 0)
    labels[left] = new
    return labels


def _adopt(labels: UInt8[ndarray, "h w"], pieces: Bool[ndarray, "h w"], before: UInt8[ndarray, "h w"]) -> None:
    """Gives each piece the id that most of its pixels had in another frame, if any had one."""
    count, piece = cv2.connectedComponents(pieces.astype(np.uint8))
    for index in range(1, count):
        inside = piece == index
        ids = np.bincount(before[inside], minlength=1)[1:]
        if ids.any():
            labels[inside] = ids.argmax() + 1
