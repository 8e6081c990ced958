"""What stands on a known ground and keeps still, and the wall behind it, without a network: by edges that are vertical.

Before a camera whose vertical is known, edges of upright things point to one place of the picture, and what lies on the
ground has few edges that do. Colours at such edges and behind the ground, against those of the ground, tell which
pixels are no ground (GrabCut). Each column of these stands where it begins, if vertical edges say that it is part of
something upright. The wall stands a little behind where the ground usually ends; the one that is assumed is farther.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import unproject_image
from lerobot_msdyn.core.images import masked_median
from lerobot_msdyn.core.observations import RobotSeen, View
from lerobot_msdyn.core.sampling import evenly, scaled_px, scaled_window

FRAMES = 40  # that the empty picture is made of
MARGIN_PX = 5.0  # of 320: about what moves
DETECTED_PX = 640  # width at which edges are looked for; smaller pictures are enlarged
VERTICAL_DEG = 4.0  # by which a vertical edge may be off
LEAST_PX = 6.0  # of 320: the shortest vertical edge
EDGE_PX = 1.2  # of 320: about an edge that is no ground ...
NEAR_PX = 8.0  # ... and probably none
AWAY_PX = 25.0  # of 320: from any vertical edge, the lowest rows are ground
LOWEST_ROWS = 0.05  # share of the rows
CUTS = 5  # iterations of GrabCut
WALL = 0.97  # share of the farthest ground from which on it is the assumed wall
BEHIND_GROUND = 1.33  # times as far as the ground usually ends (median over columns), stands the wall
BEFORE_WALL = 0.95  # share of the wall's distance up to which things stand on the ground
SMOOTH_COLUMNS = 5  # of the median of distances of feet
STEP = 0.1  # by which feet in neighbouring columns differ in distance where another thing begins
BESIDE_PX = 2.0  # of 320: how far beside a thing its vertical edges may be
OWN_SHARE = 0.4  # of an edge that belongs to a thing, at its pixels ...
OWN_PX = 4.0  # ... or as many, of 320
HIGH = 0.5  # quantile of the heights of its edges' upper ends from which on a thing is level
LEAST_EDGES = 2  # of a thing that stands ...
SPANNED = 0.4  # ... and which share of its width they span
STEEPEST_DEG = 65.0  # beyond that, things are seen from above
MOST_ROLL_DEG = 20.0  # beyond that, columns of the picture are not upright
COMPACT = 0.1  # of its distance: a wider thing that moves is hardly as deep as it is wide
LEAST_AHEAD = 0.01  # metres per metre of z: rays that go less, or back, see no upright thing
ON_GROUND = 0.999  # of the ground's depth: what is nearer stands
STANDING_ERROR, GROUND_ERROR = 0.11, 0.02  # mean errors of what stands or is behind, and of the rest, measured on desks
NO_GROUND = (cv2.GC_FGD, cv2.GC_PR_FGD)  # labels


@dataclass(frozen=True)
class Upright:
    """The vertical before a camera."""

    down: Float[ndarray, "3"]  # unit vector, in the camera's axes
    ahead: Float[ndarray, "h w"]  # metres that a ray goes horizontally, straight on, per metre of z
    falls: Float[ndarray, "h w"]  # by how much it falls, in heights of the camera above the ground
    usable: bool  # whether columns of the picture are about upright

    @classmethod
    def before(cls, up: Float[ndarray, "3"], rays: Float[ndarray, "h w 3"], camera_m: float) -> "Upright":
        """Of a camera `camera_m` above the ground, in whose axes `up` is up; `rays` have z = 1."""
        level = np.array([0.0, 0.0, 1.0]) - up[2] * up
        steep = np.degrees(np.arcsin(np.clip(-up[2], -1, 1)))
        roll = np.degrees(np.arctan2(abs(up[0]), -up[1]))
        usable = bool(steep < STEEPEST_DEG and roll < MOST_ROLL_DEG)
        ahead = rays @ (level / max(float(np.linalg.norm(level)), 1e-6))
        return cls(-up, ahead.clip(min=LEAST_AHEAD), rays @ -up / camera_m, usable)


@dataclass(frozen=True)
class Edge:
    """A vertical edge: the pixels on it, from the top down."""

    rows: Int[ndarray, " n"]
    columns: Int[ndarray, " n"]


@dataclass(frozen=True)
class Thing:
    """Something upright."""

    pixels: Bool[ndarray, "h w"]
    edges: list[Edge]  # vertical ones


def empty_scene(
    view: View, robot: RobotSeen, ground: Float[Tensor, "h w"], instances: UInt8[Tensor, "t h w"]
) -> Float[Tensor, "h w"]:
    """z-depth (m) of what keeps still before a fixed camera.

    Args:
        view: its video.
        robot: by which it is calibrated, in a world whose z points up.
        ground: z-depth (m) of the ground, and of an assumed wall behind it.
        instances: what moves.
    """
    camera, hidden = view.camera, (instances > 0) | (robot.depth > 0)
    picture, unknown = empty_picture(view.rgb.numpy(), hidden.numpy())
    rays = unproject_image(torch.ones(camera.height, camera.width), camera.intrinsics[0]).double().numpy()
    pose, intrinsics = (each[0].double().numpy() for each in (camera.world_from_camera, camera.intrinsics))
    upright = Upright.before(pose[2, :3], rays, max(float(pose[2, 3]) - robot.ground_m, 1e-3))
    return torch.from_numpy(with_uprights(ground.numpy(), picture, unknown, intrinsics, upright))


def with_boxes(
    depth: Float[Tensor, "t h w"], instances: UInt8[Tensor, "t h w"], camera: CameraTrack, ground_m: float
) -> Float[Tensor, "t h w"]:
    """Depth (m) of `with_standing` before a fixed camera over a known ground (z up), of compact things that move.

    One depth for all of a thing leans it back as far as the camera looks down. A compact one is a box instead, as deep
    as it is wide: its front stands on its foot, and its top, level, ends where it ends in the picture.
    """
    pose = camera.world_from_camera[0]
    rays = unproject_image(torch.ones(camera.height, camera.width), camera.intrinsics[0])
    above = max(float(pose[2, 3]) - ground_m, 1e-3)
    vertical = Upright.before(pose[2, :3].numpy(), rays.numpy(), above)
    if not vertical.usable:
        return depth
    ahead, falls = (torch.from_numpy(values).float() for values in (vertical.ahead, vertical.falls))
    dip = float(vertical.down[2])  # of the optical axis: a sine
    depth = depth.clone()
    for instance in range(1, int(instances.max()) + 1):
        mask = instances == instance
        frames = mask.any(2).any(1).nonzero()[:, 0]
        foot = torch.where(mask, depth, 0.0).amax((1, 2))
        front = ((foot - above * dip) / (1 - dip**2) ** 0.5).clamp(min=LEAST_AHEAD)
        wide = float((mask[frames].any(1).sum(1) * foot[frames]).median() / camera.intrinsics[0, 0, 0])
        if not wide < COMPACT * float(foot[frames].median()):  # or not there at all
            continue
        row, column = mask[frames].any(2).float().argmax(1), mask[frames].any(1).float().cumsum(1)
        column = (column >= column[:, -1:] / 2).float().argmax(1)
        back = (front[frames] + wide) / ahead[row, column]
        low = (back * falls[row, column]).median().clamp(max=1)  # how far its top is below the camera, in heights of it
        box = torch.maximum(front[:, None, None] / ahead, low / falls.clamp(min=LEAST_AHEAD))
        depth = torch.where(mask, box, depth)
    return depth


def still_error(empty: Float[Tensor, "h w"], ground: Float[Tensor, "h w"]) -> float:
    """By what share of the depth it is usually off (mean), by how much of the picture is no ground."""
    other = (empty < ON_GROUND * ground) | (ground >= WALL * ground.max())
    share = float(other.float().mean())
    return share * STANDING_ERROR + (1 - share) * GROUND_ERROR


def empty_picture(
    rgb: UInt8[ndarray, "t h w 3"], hidden: Bool[ndarray, "t h w"]
) -> tuple[UInt8[ndarray, "h w 3"], Bool[ndarray, "h w"]]:
    """Median over frames in which a pixel is not hidden, and where it is so in most; there it is filled."""
    some = evenly(len(rgb), FRAMES).numpy()
    window = scaled_window(MARGIN_PX, rgb.shape[2])
    grown = np.stack([cv2.dilate(mask.astype(np.uint8), window) > 0 for mask in hidden[some]])
    picture = masked_median(rgb[some], ~grown[..., None]).round().astype(np.uint8)
    unknown = grown.mean(0) > 0.5
    return cv2.inpaint(picture, unknown.astype(np.uint8), 3, cv2.INPAINT_TELEA), unknown


def with_uprights(
    ground: Float32[ndarray, "h w"],
    picture: UInt8[ndarray, "h w 3"],
    unknown: Bool[ndarray, "h w"],
    intrinsics: Float[ndarray, "3 3"],
    upright: Upright,
) -> Float32[ndarray, "h w"]:
    """z-depth (m) of the empty scene: never farther than the ground and the wall that is assumed behind it.

    Args:
        ground: z-depth (m) of the ground, and of an assumed wall behind it.
        picture: the empty scene, of the same camera.
        unknown: where it is not known.
        intrinsics: of the camera.
        upright: the vertical before it.
    """
    if not upright.usable:
        return ground
    behind = ground >= WALL * ground.max()
    edges = vertical_edges(picture, intrinsics, upright.down)
    edges = [edge for edge in edges if unknown[edge.rows, edge.columns].mean() < 0.5]
    labels = _first_labels(edges, behind, unknown)
    stands = _no_ground(picture, labels)
    if not stands.any():
        return ground
    distance = ground * upright.ahead
    wall = wall_m(stands, unknown, distance, behind)
    stands &= ~unknown
    labels = _more_labels(labels, stands, _things(stands & (distance < BEFORE_WALL * wall), distance, edges))
    stands = _no_ground(picture, labels)
    wall = wall_m(stands, unknown, distance, behind)
    before = stands & ~unknown & (distance < BEFORE_WALL * wall)
    depth = np.minimum(ground, wall / upright.ahead) if np.isfinite(wall) else ground.copy()
    for thing in _things(before, distance, edges):
        its, feet = thing.pixels, _lowest(thing.pixels)
        known = ~unknown[(feet + 1).clip(max=len(unknown) - 1), np.arange(len(feet))]  # else it may reach farther down
        card = distance[feet, np.arange(len(feet))] / upright.ahead
        above = 1 - card * upright.falls  # of the camera's height
        columns = np.flatnonzero(its.any(0))
        ends = [(edge.rows[0], edge.columns[0].clip(columns[0], columns[-1])) for edge in thing.edges]
        high = np.quantile([above[end] for end in ends], HIGH)
        top = np.where(upright.falls > 0, (1 - high) / upright.falls.clip(min=1e-6), np.inf)
        depth = np.where(its & known, np.minimum(depth, np.maximum(card, top)), depth)
    return depth.astype(np.float32)


def vertical_edges(
    picture: UInt8[ndarray, "h w 3"], intrinsics: Float[ndarray, "3 3"], down: Float[ndarray, "3"]
) -> list[Edge]:
    """Straight edges of any colour that point to where verticals meet in the picture.

    Args:
        picture: RGB.
        intrinsics: of its camera.
        down: in the camera's axes.
    """
    height, width = picture.shape[:2]
    scale = max(1.0, DETECTED_PX / width)
    large = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    detector = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD)
    found = [detector.detect(np.ascontiguousarray(channel))[0] for channel in np.moveaxis(large, 2, 0)]
    ends = np.concatenate([lines.reshape(-1, 2, 2) for lines in found if lines is not None] or [np.zeros((0, 2, 2))])
    ends /= scale
    ends = np.take_along_axis(ends, ends[:, :, 1].argsort(1)[:, :, None], 1)  # the upper one first
    middle, along = ends.mean(1), ends[:, 1] - ends[:, 0]
    meet = intrinsics @ down  # homogeneous: it may be infinitely far away
    towards = meet[:2] - middle * meet[2]
    cross = along[:, 0] * towards[:, 1] - along[:, 1] * towards[:, 0]
    off = np.degrees(np.arctan2(np.abs(cross), np.abs((along * towards).sum(1))))
    kept = (off < VERTICAL_DEG) & (np.hypot(*along.T) >= scaled_px(LEAST_PX, width))
    edges = []
    for top, bottom in ends[kept]:
        rows = np.arange(max(0, round(top[1])), min(height, round(bottom[1]) + 1))
        columns = np.round(np.interp(rows + 0.5, (top[1], bottom[1]), (top[0], bottom[0])) - 0.5).astype(int)
        edges.append(Edge(rows, columns.clip(0, width - 1)))
    return edges


def _first_labels(
    edges: list[Edge], behind: Bool[ndarray, "h w"], unknown: Bool[ndarray, "h w"]
) -> UInt8[ndarray, "h w"]:
    """What GrabCut begins with: no ground is behind it and at vertical edges; it is in the lowest rows.

    What is not known is ground, so that nothing spreads across it.
    """
    height, width = behind.shape
    apart = np.ones((height, width), np.uint8)
    for edge in edges:
        apart[edge.rows, edge.columns] = 0
    far = np.full((height, width), np.inf) if apart.all() else cv2.distanceTransform(apart, cv2.DIST_L2, 5)
    labels = np.full((height, width), cv2.GC_PR_BGD, np.uint8)
    labels[behind | (far < scaled_px(NEAR_PX, width))] = cv2.GC_PR_FGD
    labels[far < scaled_px(EDGE_PX, width)] = cv2.GC_FGD
    lowest = np.arange(height)[:, None] >= (1 - LOWEST_ROWS) * height
    labels[unknown | (lowest & (far > scaled_px(AWAY_PX, width)))] = cv2.GC_BGD
    return labels


def _more_labels(
    labels: UInt8[ndarray, "h w"], stands: Bool[ndarray, "h w"], things: list[Thing]
) -> UInt8[ndarray, "h w"]:
    """What it goes on with: things that were found are no ground, and what is between their pixels is probably none."""
    known = np.isin(labels, (cv2.GC_FGD, cv2.GC_BGD))
    labels = np.where(known, labels, np.where(stands, cv2.GC_PR_FGD, cv2.GC_PR_BGD)).astype(np.uint8)
    for its in (thing.pixels for thing in things):
        rows, columns = np.flatnonzero(its.any(1)), np.flatnonzero(its.any(0))
        box = labels[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        box[box == cv2.GC_PR_BGD] = cv2.GC_PR_FGD
        labels[its] = cv2.GC_FGD
    return labels


def _no_ground(picture: UInt8[ndarray, "h w 3"], labels: UInt8[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Pixels whose colours are rather those of what is labelled as no ground than those of the ground."""
    found = np.isin(labels, NO_GROUND)
    if found.all() or not found.any():
        return found
    smooth = cv2.cvtColor(cv2.bilateralFilter(picture, 5, 30, 5), cv2.COLOR_RGB2LAB)
    labels, models = labels.copy(), (np.zeros((1, 65)), np.zeros((1, 65)))
    cv2.setRNGSeed(0)  # it begins with random clusters of colours
    cv2.grabCut(smooth, labels, None, *models, CUTS, cv2.GC_INIT_WITH_MASK)
    found = np.isin(labels, NO_GROUND)
    return cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0


def wall_m(
    stands: Bool[ndarray, "h w"],
    unknown: Bool[ndarray, "h w"],
    distance: Float[ndarray, "h w"],
    behind: Bool[ndarray, "h w"],
) -> float:
    """How far away the wall is (m, straight on).

    Args:
        stands: what is no ground.
        unknown: where nothing is known.
        distance: of the ground.
        behind: where the assumed wall is.
    """
    wall = float(distance[behind].mean()) if behind.any() else np.inf
    columns = np.arange(distance.shape[1])
    end = (~(stands | unknown)).argmax(0)  # the farthest row of the ground
    seen = (end > 0) & ~unknown[end - 1, columns]
    return min(wall, BEHIND_GROUND * float(np.median(distance[end, columns][seen]))) if seen.any() else wall


def _things(before: Bool[ndarray, "h w"], distance: Float[ndarray, "h w"], edges: list[Edge]) -> list[Thing]:
    """What stands upright.

    Args:
        before: what is no ground, and nearer than the wall.
        distance: of the ground (m, straight on).
        edges: vertical ones.
    """
    count, piece = cv2.connectedComponents(before.astype(np.uint8))
    things = []
    for index in range(1, count):
        columns = np.flatnonzero((piece == index).any(0))
        away = np.log(distance[_lowest(piece == index)[columns], columns]).astype(np.float32)
        if len(away) >= SMOOTH_COLUMNS:
            away = cv2.medianBlur(away[None], SMOOTH_COLUMNS)[0]
        begins = np.flatnonzero((np.abs(np.diff(away)) > STEP) | (np.diff(columns) > 1)) + 1
        for some in np.split(columns, begins):
            its = np.zeros_like(before)
            its[:, some] = piece[:, some] == index
            own = [edge for edge in edges if _is_of(edge, its)]
            middles = [edge.columns.mean() for edge in own]
            if len(own) >= LEAST_EDGES and np.ptp(middles) >= SPANNED * len(some):
                things.append(Thing(its, own))
    return things


def _lowest(mask: Bool[ndarray, "h w"]) -> Int[ndarray, " w"]:
    """The last row of each column that is in a mask; the picture's last row where none is."""
    return len(mask) - 1 - mask[::-1].argmax(0)


def _is_of(edge: Edge, its: Bool[ndarray, "h w"]) -> bool:
    """Whether much of an edge is at pixels of a thing."""
    width = its.shape[1]
    reach = round(scaled_px(BESIDE_PX, width))
    shifted = [(edge.columns + shift).clip(0, width - 1) for shift in (-reach, 0, reach)]
    inside = np.any([its[edge.rows, columns] for columns in shifted], axis=0)
    return bool(inside.mean() >= OWN_SHARE or inside.sum() >= scaled_px(OWN_PX, width))
