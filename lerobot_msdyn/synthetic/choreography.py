"""What moves in each kind of scene: the gripper's path, what it touches, and the arm that follows; or a person's hand.

World frame: z up, the table top is z = 0, x to the right and y away from the recorded camera. The gripper's frame
has its origin between the finger tips, z towards the palm and x across the opening; so has the hand's.
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.synthetic.rigid import from_axes, pose

KINDS = ("push", "lid", "sheet", "hand", "spin", "static", "all")
STATE_NAMES = ("gripper.x", "gripper.y", "gripper.z", "gripper.yaw", "gripper.pitch", "gripper.opening")

SHOULDER = np.array([-0.24, 0.25, 0.13])
LINK = 0.27  # m, upper arm and forearm alike
WRIST = 0.13  # m, from the finger tips up to the wrist
FINGER = (0.006, 0.010, 0.034)  # m, half extents
BLOCK_HALF = (0.046, 0.030, 0.020)
CONTAINER = np.array([0.205, 0.165, 0.0])  # centre of its base
CONTAINER_HALF = (0.070, 0.050, 0.030)
HINGE = np.array([CONTAINER[0], CONTAINER[1] + CONTAINER_HALF[1], 0.064])
TAB = np.array([0.0, -0.117, 0.0])  # the lid's handle in the lid's frame, which lies on the hinge
SHEET_SIZE = (0.20, 0.16)  # m, along (bends) and across
SHEET_CORNER = np.array([0.262, -0.215, 0.0015])  # fixed end of the edge that is nearer to the camera
SHEET_SEGMENTS = 36
DOWEL_RADIUS = 0.006
PARKED = np.array([-0.12, 0.21, 0.17, 0.0, 0.0, 0.03])  # state of an arm that is not used
KNUCKLE = (0.036, 0.084)  # m, across and above the finger tips
FINGER_GIRTH = 0.009  # m, half extent of a hand's fingers
SPREAD = {"thumb": 0.0, "index": 0.023, "middle": 0.0, "ring": -0.022}  # m along the palm; the thumb is opposite
HUB = np.array([-0.01, 0.075, 0.155])  # of the windmill


@dataclass(frozen=True)
class Choreography:
    """Everything that a kind decides, per frame."""

    states: np.ndarray  # [t, 6] metres and radians, see STATE_NAMES
    poses: dict[str, np.ndarray]  # body -> world_from_body [t, 4, 4]
    sheet_nodes: np.ndarray  # [t, SHEET_SEGMENTS + 1, 3]
    sheet_across: np.ndarray  # [3]


def ease(time: np.ndarray, start: float, stop: float) -> np.ndarray:
    """Minimum-jerk progress from 0 at `start` to 1 at `stop`, as people and arms move."""
    s = np.clip((time - start) / (stop - start), 0, 1)
    return s**3 * (10 - 15 * s + 6 * s**2)


def _through(time: np.ndarray, keys: list[tuple[float, np.ndarray]]) -> np.ndarray:
    """States [t, 6] that come to rest at every key (time, state)."""
    states = np.broadcast_to(keys[0][1], (len(time), 6)).copy()
    for (start, before), (stop, after) in pairwise(keys):
        states += ease(time, start, stop)[:, None] * (after - before)
    return states


def _at(state: np.ndarray, **changes: float) -> np.ndarray:
    """A state with some of x, y, z, yaw, pitch, opening replaced."""
    out = state.copy()
    for name, value in changes.items():
        out[("x", "y", "z", "yaw", "pitch", "opening").index(name)] = value
    return out


def gripper_pose(state: np.ndarray) -> np.ndarray:
    """World-from-gripper pose [4, 4] of one state."""
    return pose(state[:3], yaw=state[3], pitch=state[4])


def _push(time: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Gripper states and block poses: a closed gripper pushes the block along an arc and withdraws."""
    start = np.array([rng.uniform(-0.148, -0.120), rng.uniform(-0.11, -0.06)])
    yaw, turn, length = rng.uniform(-0.15, 0.2), rng.uniform(-0.45, 0.6), rng.uniform(0.095, 0.115)
    arc = _arc(ease(time, 0.30, 0.74), yaw, turn, length)
    gap = BLOCK_HALF[0] + 2 * FINGER[0] + 0.0005
    # the block keeps its place in front of the closed fingers
    offsets = gap * np.stack((np.cos(arc[:, 2]), np.sin(arc[:, 2])), -1)
    centers = start + arc[:, :2] + offsets - gap * _heading(yaw)
    blocks = np.stack([pose((*center, BLOCK_HALF[2]), yaw=y) for center, y in zip(centers, arc[:, 2], strict=True)])
    first, last = start - gap * _heading(yaw), _arc(np.ones(1), yaw, turn, length)[0]
    lean = rng.uniform(-0.25, -0.05)
    touch = np.array([*first, 0.012, yaw, lean, 0.0])
    behind = touch - np.array([*(0.025 * _heading(yaw)), 0, 0, 0, 0])
    end = np.array([*(first + last[:2]), 0.012, yaw + turn, lean, 0.0])
    clear = end - np.array([*(0.03 * _heading(yaw + turn)), 0, 0, 0, 0])
    above, away = (_at(state, y=state[1] + 0.03, z=0.085, opening=0.03) for state in (behind, clear))
    states = _through(time, [(0.0, above), (0.22, behind), (0.30, touch)])
    states[:, [0, 1, 3]] += arc - (0, 0, yaw)
    states += _through(time, [(0.74, end), (0.82, clear), (1.0, away)]) - end
    return states, blocks


def _heading(yaw: float) -> np.ndarray:
    return np.array([math.cos(yaw), math.sin(yaw)])


def _arc(progress: np.ndarray, yaw: float, turn: float, length: float) -> np.ndarray:
    """Displacement x, y and heading [t, 3] along an arc whose heading goes from `yaw` to `yaw + turn`."""
    way = np.linspace(0, 1, 65)
    steps = np.stack([_heading(yaw + turn * (a + b) / 2) for a, b in pairwise(way)]) * length / 64
    path = np.vstack(([[0.0, 0.0]], np.cumsum(steps, axis=0)))
    x, y = (np.interp(progress, way, path[:, i]) for i in range(2))
    return np.stack((x, y, yaw + turn * progress), -1)


def _lid_poses(angle: np.ndarray) -> np.ndarray:
    """Poses [t, 4, 4] of the lid, opened by `angle` radians about the hinge at its far edge."""
    return np.stack([pose(HINGE, pitch=-a) for a in angle])


def _open_lid(time: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Gripper states and lid angles: the fingers take the tab, open the lid, let go."""
    angle = ease(time, 0.28, 0.78) * rng.uniform(1.15, 1.45)
    tabs = _lid_poses(angle) @ np.append(TAB, 1.0)
    hold = np.array([tabs[0, 0], tabs[0, 1], tabs[0, 2] - 0.006, 0.0, 0.0, 0.0165])
    wide = _at(hold, opening=0.05)
    states = _through(time, [(0.0, _at(wide, y=hold[1] - 0.02, z=hold[2] + 0.07)), (0.20, wide), (0.28, hold)])
    states[:, :3] += tabs[:, :3] - tabs[0, :3]
    states += _through(time, [(0.80, hold), (0.86, wide), (1.0, _at(wide, z=hold[2] + 0.05))]) - hold
    return states, angle


def _sheet_nodes(curl: float, angle: float) -> np.ndarray:
    """One long edge of the sheet [S + 1, 3]: the free part of a flat sheet is bent up by `angle` (isometric).

    The first part, 1 - curl of the length, stays on the table; in the rest the slope grows smoothly, so the
    curvature has no jump and every segment moves on its own.
    """
    length, _ = SHEET_SIZE
    step = length / SHEET_SEGMENTS
    middle = (np.arange(SHEET_SEGMENTS) + 0.5) * step
    free = np.clip((middle - (1 - curl) * length) / (curl * length), 0, 1)
    slope = angle * free**2 * (3 - 2 * free)
    moves = np.stack((-np.cos(slope), np.zeros_like(slope), np.sin(slope)), -1) * step
    return np.vstack((SHEET_CORNER, SHEET_CORNER + np.cumsum(moves, axis=0)))


def _bend_sheet(time: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Sheet nodes [t, S + 1, 3] and dowel poses [t, 4, 4]: lifted and rolled over, then let down by a third."""
    angle = rng.uniform(1.7, 2.2) * (ease(time, 0.25, 0.70) - 0.35 * ease(time, 0.70, 0.97))
    curl = 0.55 + 0.3 * ease(time, 0.25, 0.75)
    nodes = np.stack([_sheet_nodes(c, a) for c, a in zip(curl, angle, strict=True)])
    dowels = []
    for chain in nodes:
        tangent = (chain[-1] - chain[-2]) / np.linalg.norm(chain[-1] - chain[-2])
        normal = np.cross((0.0, 1.0, 0.0), tangent)
        center = chain[-1] + (0, SHEET_SIZE[1] / 2, 0) + normal * (DOWEL_RADIUS - SHEET_CORNER[2] + 0.0005)
        dowels.append(from_axes(-tangent, np.array([0.0, 1.0, 0.0]), np.cross(-tangent, (0.0, 1.0, 0.0)), center))
    return nodes, np.stack(dowels)


def _lift_sheet(time: np.ndarray, dowels: np.ndarray) -> np.ndarray:
    """Gripper states that take the dowel's far end and stay with it."""
    ends = dowels[:, :3, 3] + (0.0, SHEET_SIZE[1] / 2 + 0.018, 0.0)
    hold = np.array([ends[0, 0], ends[0, 1], 0.004, 0.0, 0.0, 2 * DOWEL_RADIUS + 0.0005])
    wide = _at(hold, opening=0.05)
    states = _through(time, [(0.0, _at(wide, y=hold[1] + 0.03, z=0.075)), (0.18, wide), (0.25, hold)])
    states[:, :3] += ends - ends[0]
    return states


def _take(time: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """States [t, 6] of the hand (the last is what its fingers open by, rad) and block poses.

    The hand closes on the block, carries it over the table in a bow, turns it, puts it down and goes.
    """
    way = ease(time, 0.30, 0.72)
    start, yaw = np.array([rng.uniform(-0.01, 0.02), rng.uniform(-0.13, -0.10)]), rng.uniform(-0.2, 0.3)
    goal = np.array([rng.uniform(-0.15, -0.13), rng.uniform(-0.03, 0.0)])
    block = np.zeros((len(time), 6))
    block[:, :2] = start + way[:, None] * (goal - start)
    block[:, 2] = BLOCK_HALF[2] + rng.uniform(0.05, 0.07) * np.sin(np.pi * way) ** 2
    block[:, 3] = yaw - rng.uniform(0.6, 1.0) * way
    block[:, 4] = rng.uniform(0.2, 0.35) * np.sin(np.pi * way) ** 2
    first, last = block[0], block[-1]
    states = _through(time, [(0.0, _aside(first, 0.09)), (0.20, _aside(first, 0.0)), (0.28, first)]) + block - first
    states += _through(time, [(0.74, last), (0.82, _aside(last, 0.0)), (1.0, _aside(last, 0.07))]) - last
    return states, np.stack([gripper_pose(state) for state in block])


def _aside(hold: np.ndarray, metres: float) -> np.ndarray:
    """The hand open, and so far up, and towards the person."""
    return _at(hold, y=hold[1] + 0.6 * metres, z=hold[2] + metres, opening=0.5)


def _hand_poses(states: np.ndarray) -> dict[str, np.ndarray]:
    """Poses [t, 4, 4] of the palm (with the forearm) and of rigid fingers that turn about their knuckles.

    The fingers close across the y axis of a state's pose.
    """
    across, above = KNUCKLE
    poses = {"palm": np.stack([gripper_pose(state) @ pose((0, 0, 0), yaw=-math.pi / 2) for state in states])}
    for name, along in SPREAD.items():
        side = -1 if name == "thumb" else 1
        knuckle = [pose((side * across, along, above), roll=-side * state[5]) for state in states]
        poses[name] = poses["palm"] @ np.stack(knuckle)
    return poses


def _windmill_poses(time: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Poses [t, 4, 4] of its stand and of its rotor, which gathers way and turns once or more about its y axis."""
    turned = 2 * math.pi * rng.uniform(1.0, 1.5) * time**2 * (3 - time) / 2
    axle = pose(HUB, yaw=rng.uniform(-0.3, 0.3), pitch=-0.2)
    return {
        "stand": np.broadcast_to(np.eye(4), (len(time), 4, 4)),
        "rotor": np.stack([axle @ pose((0, 0, 0), roll=angle) for angle in turned]),
    }


def arm_poses(states: np.ndarray) -> dict[str, np.ndarray]:
    """Poses [t, 4, 4] of the arm's bodies for gripper states (two equal links, elbow up).

    Raises:
        ConfigError: a state is out of the arm's reach.
    """
    bodies: dict[str, list[np.ndarray]] = {
        name: [] for name in ("turret", "upper_arm", "forearm", "gripper", "finger_left", "finger_right")
    }
    for state in states:
        gripper = gripper_pose(state)
        wrist = gripper[:3, 3] + WRIST * gripper[:3, 2]
        reach = wrist - SHOULDER
        distance = float(np.linalg.norm(reach))
        if distance >= 2 * LINK:
            raise ConfigError(f"gripper state {state.round(3).tolist()} is {distance:.3f} m away; reach {2 * LINK} m")
        bearing = math.atan2(reach[1], reach[0])
        lift = math.asin(reach[2] / distance) + math.acos(distance / (2 * LINK))
        out = np.array([math.cos(bearing), math.sin(bearing), 0.0])
        side = np.array([-math.sin(bearing), math.cos(bearing), 0.0])
        upper = out * math.cos(lift) + np.array([0.0, 0.0, math.sin(lift)])
        elbow = SHOULDER + LINK * upper
        lower = (wrist - elbow) / LINK
        bodies["turret"].append(pose(SHOULDER, yaw=bearing))
        bodies["upper_arm"].append(from_axes(np.cross(side, upper), side, upper, SHOULDER))
        bodies["forearm"].append(from_axes(np.cross(side, lower), side, lower, elbow))
        bodies["gripper"].append(gripper)
        apart = state[5] / 2 + FINGER[0]
        bodies["finger_left"].append(gripper @ pose((-apart, 0, 0)))
        bodies["finger_right"].append(gripper @ pose((apart, 0, 0)))
    return {name: np.stack(poses) for name, poses in bodies.items()}


def choreograph(kind: str, frames: int, rng: np.random.Generator) -> Choreography:
    """The motion of one episode; `rng` varies where things start and how far they go.

    Raises:
        ConfigError: the kind is unknown or there is no frame.
    """
    if kind not in KINDS:
        raise ConfigError(f"synthetic scene kind {kind!r} is unknown; expected one of {', '.join(KINDS)}")
    if frames < 1:
        raise ConfigError(f"a synthetic scene needs at least 1 frame, got {frames}")
    time = np.linspace(0, 1, frames) if frames > 1 else np.zeros(1)
    rest = np.zeros_like(time)
    push_states, blocks = _push(time if kind in ("push", "all") else rest, rng)
    lid_states, angle = _open_lid(time if kind in ("lid", "all") else rest, rng)
    nodes, dowels = _bend_sheet(time if kind in ("sheet", "all") else rest, rng)
    states = {"push": push_states, "all": push_states, "lid": lid_states, "static": push_states}.get(kind)
    if states is None:
        states = _lift_sheet(time, dowels) if kind == "sheet" else np.tile(PARKED, (frames, 1))
    visitor: dict[str, np.ndarray] = {}
    if kind == "hand":
        hand, blocks = _take(time, rng)
        visitor = _hand_poses(hand)
    elif kind == "spin":
        visitor = _windmill_poses(time, rng)
    still = np.broadcast_to(np.eye(4), (frames, 4, 4))
    bodies = {"block": blocks, "lid": _lid_poses(angle), "dowel": dowels, **visitor}
    poses = {"world": still, **arm_poses(states), **bodies}
    return Choreography(states, poses, nodes, np.array([0.0, SHEET_SIZE[1], 0.0]))
