"""Things that lie on the ground rather than stand upright on it, told by how they slide, and how high they are.

Of depth that is assumed, an instance is a card that stands on its foot: right for a bottle, wrong for a keyboard or a
book that is pushed about. Between the card and the ground lies a family of planes through the foot. What slides turns
about the vertical and keeps its height, so that each plane says where its points must be seen at other times; the one
is taken that says so best. A similar thing at another height would be seen in the same places: its thickness is told by
the robot that touches it, if at all.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import nearest_pixel, project, unproject, unproject_image
from lerobot_msdyn.core.observations import PointTracks, RobotSeen
from lerobot_msdyn.core.sampling import evenly, scaled_px
from lerobot_msdyn.priors.registry import Depth, Masks
from lerobot_msdyn.priors.robot import LEAST_TOUCHED, with_touching

UPRIGHT = (0.0, 0.25, 0.5, 0.75, 1.0)  # shares of the way from the ground to the depth so far, in inverse depth
BETTER = 0.9  # of the error so far: as much a plane must lower it to; what differs by less is as good
MOST_PX = 1.5  # of 320, median: what is farther from where it must be does not slide
FRAMES = 24  # that are compared
LEAST_POINTS = 20
LEAST_SEEN = 8  # points that a frame must share with the one in which most are seen
MOVED_PX = 3.0  # of 320, median: frames in which a thing is nearer to that place tell nothing
OUTLIERS = 3.0  # times the median error beyond which a point does not count
LEAST_TOUCHES = 3  # frames in which the robot must touch a thing
LOWEST = 0.2  # quantile of the heights of the links' pixels where they touch: of each frame, and over frames
MOST_SHARE = 0.2  # of the camera's height that a thing that lies may be high


@dataclass(frozen=True)
class Ground:
    """A plane before the camera, in its axes."""

    point: Float[Tensor, "3"]  # m
    axes: Float[Tensor, "3 3"]  # rows: two along the plane, and the normal, towards the camera

    @classmethod
    def under(cls, points: Float[Tensor, "n 3"]) -> "Ground":
        """The plane through points."""
        centre = points.mean(0)
        axes = torch.linalg.svd(points - centre, full_matrices=False).Vh
        return cls(centre, axes if float(axes[2] @ centre) < 0 else axes * torch.tensor([[1.0], [-1.0], [-1.0]]))

    @property
    def camera_m(self) -> float:
        """Height of the camera above it."""
        return -float(self.axes[2] @ self.point)

    def coordinates(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Along the plane, and the height above it (m)."""
        return (points - self.point) @ self.axes.T

    def points(self, coordinates: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """The inverse."""
        return coordinates @ self.axes + self.point


def with_lying(
    depth: Depth, instances: Masks, tracks: PointTracks, camera: CameraTrack, robot: RobotSeen | None = None
) -> Depth:
    """Depth in which instances lie as flat as their motion says.

    Args:
        depth: with the ground that it stands on; without one it stays as it is.
        instances: what moves.
        tracks: points on it.
        camera: a fixed one.
        robot: which may touch them.
    """
    if depth.ground is None or not len(tracks):
        return depth
    z, ground = depth.z, depth.ground
    lying = []
    for instance in tracks.instance.unique().tolist():
        rows = tracks.instance == instance
        if int(rows.sum()) < LEAST_POINTS:
            continue
        its = instances == instance
        plane = _under(tracks.xy[rows], tracks.visible[rows], ground, camera)
        if plane is None:
            continue
        share = _upright(z, ground, plane, tracks.xy[rows], tracks.visible[rows], camera)
        if share == 1:
            continue
        high = 0.0 if robot is None else _height(its, robot, plane, camera)
        card = torch.where(z > 0, z, ground)  # at its edges depth of a network may be unknown
        z = torch.where(its, (1 - high / plane.camera_m) / (share / card + (1 - share) / ground), z)
        lying.append(instance)
    return replace(depth, z=z, lying=frozenset(lying))


def _under(
    xy: Float[Tensor, "n t 2"], visible: Bool[Tensor, "n t"], ground: Float[Tensor, "h w"], camera: CameraTrack
) -> Ground | None:
    """The ground where a thing is seen; None where that is before the wall, which is assumed behind the ground."""
    seen = xy[visible]
    depth = ground[nearest_pixel(seen, camera.width, camera.height)]
    points = unproject(seen, depth, camera.intrinsics[0])[depth < ground.max()]
    return Ground.under(points) if len(points) >= LEAST_POINTS else None


def _upright(
    z: Float[Tensor, "t h w"],
    ground: Float[Tensor, "h w"],
    plane: Ground,
    xy: Float[Tensor, "n t 2"],
    visible: Bool[Tensor, "n t"],
    camera: CameraTrack,
) -> float:
    """The least share of `UPRIGHT` at which a thing that slides is seen where it must be; 1 where none is better."""
    frames = evenly(len(z), FRAMES)
    xy, visible = xy[:, frames], visible[:, frames]
    first = int(visible.sum(0).argmax())
    kept = visible[:, first]
    xy, visible = xy[kept], visible[kept]
    pixel = nearest_pixel(xy[:, first], camera.width, camera.height)
    own, under = z[(torch.full_like(pixel[0], int(frames[first])), *pixel)], ground[pixel]
    known = own > 0
    xy, visible, own, under = xy[known], visible[known], own[known], under[known]
    apart = torch.where(visible, (xy - xy[:, first : first + 1]).norm(dim=-1), torch.nan).nanmedian(0).values
    usable = (visible.sum(0) >= LEAST_SEEN) & (apart > scaled_px(MOVED_PX, camera.width))
    if len(xy) < LEAST_POINTS or not bool(usable.any()):
        return 1.0
    errors = {}
    for share in UPRIGHT:
        z_share = 1 / (share / own + (1 - share) / under)
        there = plane.coordinates(unproject(xy[:, first], z_share, camera.intrinsics[0]))
        found = [
            _slid_px(there[visible[:, k]], xy[visible[:, k], k], plane, camera) for k in usable.nonzero()[:, 0].tolist()
        ]
        errors[share] = float(torch.tensor(found).median())
    least = min(errors.values())
    flattest = next(share for share in UPRIGHT if BETTER * errors[share] <= least)
    slides = errors[flattest] < scaled_px(MOST_PX, camera.width)
    return flattest if slides and errors[flattest] < BETTER * errors[1.0] else 1.0


def _slid_px(there: Float[Tensor, "n 3"], xy: Float[Tensor, "n 2"], plane: Ground, camera: CameraTrack) -> float:
    """How far points of a thing that slid are from where they must be seen (px, median), the best slide given.

    Args:
        there: along the ground and above it, before it slid.
        xy: where they are seen now.
        plane: the ground.
        camera: that sees them.
    """
    rays = unproject(xy, torch.ones(len(xy)), camera.intrinsics[0]) @ plane.axes.T
    above = plane.camera_m - there[:, 2]
    eye = plane.coordinates(torch.zeros(3))
    now = eye[:2] + rays[:, :2] * (above / -rays[:, 2].clamp(max=-1e-6))[:, None]
    weights = torch.ones(len(xy))
    away = weights
    for _ in range(2):
        share = (weights / weights.sum())[:, None]
        a, b = there[:, :2] - (share * there[:, :2]).sum(0), now - (share * now).sum(0)
        cross, dot = (share[:, 0] * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])).sum(), (share * a * b).sum()
        cosine, sine = dot / torch.hypot(dot, cross), cross / torch.hypot(dot, cross)
        turn = torch.stack((torch.stack((cosine, sine)), torch.stack((-sine, cosine))))
        moved = a @ turn + (share * now).sum(0)
        seen, _ = project(plane.points(torch.cat((moved, there[:, 2:]), 1)), camera.intrinsics[0])
        away = (seen - xy).norm(dim=-1)
        weights = (away <= OUTLIERS * away.median()).float()
    return float(away.median())


def _height(its: Bool[Tensor, "t h w"], robot: RobotSeen, plane: Ground, camera: CameraTrack) -> float:
    """How high above the ground the robot touches a thing, at the lowest (m): it is at least about as thick."""
    heights = []
    for mask, depth, moving in zip(its, robot.depth, robot.moving, strict=True):
        touched = with_touching(mask) & ~mask & moving & (depth > 0)
        if int(touched.sum()) >= LEAST_TOUCHED:
            points = unproject_image(depth, camera.intrinsics[0])[touched]
            heights.append(plane.coordinates(points)[:, 2].quantile(LOWEST))
    if len(heights) < LEAST_TOUCHES:
        return 0.0
    return float(torch.stack(heights).quantile(LOWEST).clamp(0, MOST_SHARE * plane.camera_m))
