"""Where the fixed cameras of a dataset stand, by the joints of the robot that they film (docs/robots.md)."""

import contextlib
import json
import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
from jaxtyping import Float64, UInt8
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import OBS_STATE
from numpy import ndarray

from lerobot_msdyn.augment.asked import asks_the_joints
from lerobot_msdyn.augment.backgrounds import looked_at
from lerobot_msdyn.core.config import Recipe, RobotConfig
from lerobot_msdyn.core.errors import ConfigError, DatasetError, EpisodeError, PriorError
from lerobot_msdyn.core.files import cache_folder, write_whole
from lerobot_msdyn.core.sampling import REFERENCE_WIDTH, evenly
from lerobot_msdyn.dataset.calibration import read_robot
from lerobot_msdyn.dataset.checks import picture_size
from lerobot_msdyn.dataset.read import read_colour
from lerobot_msdyn.dataset.rows import read_rows, values_of
from lerobot_msdyn.priors.camera.stands import is_displaced
from lerobot_msdyn.priors.masks.robot import RobotPictures
from lerobot_msdyn.robots import JointMap, Robot, find_description, load_robot, map_joints
from lerobot_msdyn.robots.calibration.frames import spread_frames, surface
from lerobot_msdyn.robots.calibration.picture import links_over
from lerobot_msdyn.robots.calibration.record import RobotRecord
from lerobot_msdyn.robots.calibration.refine import Solution
from lerobot_msdyn.robots.calibration.solve import Verdict, solve, with_joints
from lerobot_msdyn.robots.calibration.units import fit, is_settled
from lerobot_msdyn.robots.mapping import in_units

logger = logging.getLogger(__name__)

FRAMES = 96  # that are looked at of each place
MIN_FRAMES = 12
MAX_EPISODES = 10  # whose states are looked at
FRAMES_LOOKED_AT = 3000  # whose states are compared
NORMALISED = 100.5  # largest value of a state that may be in shares of the joints' ranges
NAME = "calibration.json"
NAMED = 5  # episodes, in words

States = dict[int, Float64[ndarray, "t s"]]  # by episode
Frames = dict[int, list[int]]  # by episode, ascending


@dataclass(frozen=True)
class Place:
    """Where a camera stood in some episodes, and what its pictures say of it."""

    episodes: list[int]
    frames: Frames  # that were looked at
    pictures: UInt8[ndarray, "k h w 3"]  # at most 320 wide
    verdict: Verdict | None = None
    joints: Float64[ndarray, "k j"] | None = None  # their values (rad, m) in these frames, as the verdict has them

    @property
    def doubt(self) -> str:
        """Why it is not to be used; empty if it is."""
        if self.verdict is None:
            return f"only {len(self.pictures)} frames show it; at least {MIN_FRAMES} are needed: add episodes"
        return self.verdict.doubt


@dataclass(frozen=True)
class RobotCameras:
    """The cameras of a dataset by its robot's joints."""

    robot: Robot
    mapping: JointMap
    episodes: list[int]  # that were looked for
    places: dict[str, list[Place]]  # of each camera

    @property
    def believed(self) -> list[Verdict]:
        """Those that are to be used."""
        verdicts = (place.verdict for places in self.places.values() for place in places)
        return [verdict for verdict in verdicts if verdict is not None and verdict.confident]

    def named(self) -> Iterator[tuple[str, str, Place]]:
        """All places, each with a name for files and in words."""
        for key, places in self.places.items():
            for number, place in enumerate(places):
                name = "_".join(("links", key.rsplit(".", 1)[-1], *([str(number)] if len(places) > 1 else [])))
                shown = ", ".join(map(str, place.episodes[:NAMED])) + (", ..." if len(place.episodes) > NAMED else "")
                yield name, key if len(places) == 1 else f"{key} in episodes {shown}", place

    def picture(self, place: Place) -> bytes:
        """Frames with the links drawn over them (PNG); of a place with a verdict."""
        assert place.verdict is not None
        assert place.joints is not None
        drawn = links_over(self.robot, place.verdict.solution.pose, place.pictures, place.joints)
        return bytes(cv2.imencode(".png", drawn[..., ::-1])[1])

    def content(self, source: LeRobotDatasetMetadata) -> dict[str, Any]:
        """Of a calibration file (docs/calibration.md): by episode where a camera stood in several places."""
        record = {"robot": self._record()}
        if all(len(places) == 1 and places[0].episodes == self.episodes for places in self.places.values()):
            return {"cameras": self._cameras(source, self.episodes[0])} | record
        return {"episodes": {str(one): {"cameras": self._cameras(source, one)} for one in self.episodes}} | record

    def _cameras(self, source: LeRobotDatasetMetadata, episode: int) -> dict[str, Any]:
        """Those that are believed of an episode."""
        verdicts = {
            key: place.verdict for key, places in self.places.items() for place in places if episode in place.episodes
        }
        return {
            key: _entry(verdict, source.features[key])
            for key, verdict in verdicts.items()
            if verdict is not None and verdict.confident
        }

    def _record(self) -> dict[str, Any]:
        """The robot, with the joints as its cameras corrected them: all alike (`_in_one_world`)."""
        solution = max(self.believed, key=lambda verdict: verdict.hits).solution
        scale, offset = self.mapping.scale * solution.scale, self.mapping.offset * solution.scale + solution.offset
        corrected = replace(self.mapping, scale=scale, offset=offset)
        urdf = Path(self.robot.source).absolute()
        return RobotRecord(urdf, self.robot.licence, corrected, self.robot.movable, solution.lag_s).entry()


def calibrated[R: Recipe](
    source: LeRobotDatasetMetadata, episodes: Sequence[int], cameras: Sequence[str], config: R, folder: Path
) -> R:
    """The settings with a calibration file, where there is none yet and the robot's joints tell where cameras stand.

    The file, and pictures of the links over the video, are written to a folder; they are used if they are there before.
    Without a description of the robot, or where no camera is told, they stay as they are, and the log says why.

    Raises:
        ConfigError: the description that they name cannot be used.
    """
    extra = calibration_episodes(source, config)
    cameras = [key for key in cameras if config.camera.pose_column(key) is None]
    if not cameras or not extra:
        return config
    path = folder / NAME
    if not path.exists():
        try:
            found = robot_cameras(source, cameras, sorted({*episodes, *extra}), config.robot)
        except (ConfigError, DatasetError, PriorError) as error:
            if isinstance(error, ConfigError) and (config.robot.urdf is not None or config.robot.name):
                raise
            logger.info("the robot's joints are not used to locate cameras: %s", error)
            return config
        for name, where, place in found.named():
            text = f"not used, {place.doubt}" if place.verdict is None or place.doubt else summary(place.verdict)
            logger.info("%s by the joints of %s: %s", where, found.robot.name, text)
            if place.verdict is not None:
                write_whole(folder / f"{name}.png", found.picture(place))
        if not found.believed:
            return config
        write_whole(path, json.dumps(found.content(source), indent=1).encode())
    return replace(config, camera=replace(config.camera, calibration=path))


def calibrated_before[R: Recipe](config: R, folder: Path) -> R:
    """The settings with the calibration file that `calibrated` has written to a folder, if it has written one.

    Raises:
        PriorError: the robot's description that it names is not on this machine.
    """
    path = folder / NAME
    if not path.exists():
        return config
    robot = read_robot(path)
    if robot is not None and not robot.urdf.is_file():
        raise PriorError(
            f"{robot.urdf} is not on this machine; the cameras were found by this description of the robot: put it "
            "there, or name one that all machines see by --robot.urdf"
        )
    return replace(config, camera=replace(config.camera, calibration=path))


def publish(folder: Path, place: Path) -> None:
    """Copies what `calibrated` wrote, if it wrote anything, without the user's folders, to a place in the output."""
    for path in sorted(folder.glob("*.png")):
        write_whole(place / path.name, path.read_bytes())
    if (folder / NAME).exists():
        content = json.loads((folder / NAME).read_text())
        content["robot"]["urdf"] = Path(content["robot"]["urdf"]).name
        write_whole(place / NAME, json.dumps(content, indent=1).encode())


def calibration_episodes(source: LeRobotDatasetMetadata, config: Recipe) -> list[int]:
    """The episodes that tell where cameras stand, beside those that are worked on; none where that is known."""
    return looked_at(source.total_episodes) if asks_the_joints(config) else []


def robot_cameras(
    source: LeRobotDatasetMetadata,
    cameras: Sequence[str],
    episodes: Sequence[int],
    config: RobotConfig,
    frames: int = FRAMES,
    max_episodes: int = MAX_EPISODES,
) -> RobotCameras:
    """The fixed cameras of a dataset, in the frame of its robot's root.

    Args:
        source: the dataset.
        cameras: feature keys.
        episodes: those to look at.
        config: the robot.
        frames: to look at of each place in which a camera stood.
        max_episodes: of which frames are taken, evenly spread over those of a place.

    Raises:
        ConfigError: the robot's description cannot be had, or the state is not that of its joints.
        DatasetError: there is no state, or too few frames.
    """
    robot = described(source, config)
    of_cameras = {key: places_of(source, key, episodes) for key in cameras}
    read = {index for places in of_cameras.values() for one in places for index in _some(one, max_episodes)}
    states = states_of(source, sorted(read))
    mapping = joints_of(source, robot, states, config)
    places: dict[str, list[Place]] = {}
    for key, groups in of_cameras.items():
        places[key] = []
        for group in groups:
            own = {index: states[index] for index in _some(group, max_episodes) if index in states}
            places[key].append(Place(group, *_pictures(source, key, _spread(robot, mapping, own, frames))))
    longest = max(len(place.pictures) for of_camera in places.values() for place in of_camera)
    if longest < MIN_FRAMES:
        raise DatasetError(f"{source.repo_id}: {longest} frames; expected at least {MIN_FRAMES}: add episodes")
    tried = []
    mappings = _mappings(robot, mapping, states, config)
    for each in mappings:
        solved = {
            key: [_solved(robot, each, one, states, source.fps) for one in group] for key, group in places.items()
        }
        best = max((one.verdict for group in solved.values() for one in group if one.verdict is not None), key=fit)
        tried.append((fit(best), RobotCameras(robot, each, list(episodes), solved)))
        if is_settled(each, best, mappings):
            break
        logger.info("joints in %s: %.0f %% of the outlines lie on edges", each.units, 100 * best.hits)
    return _in_one_world(max(tried, key=lambda item: item[0])[1], states, source.fps)


def _in_one_world(found: RobotCameras, states: States, fps: int | float) -> RobotCameras:
    """The joints as the camera with the most hits corrected them, for all cameras that are believed."""
    if len(found.believed) < 2:
        return found
    best = max(found.believed, key=lambda verdict: verdict.hits).solution

    def again(place: Place) -> Place:
        verdict = place.verdict
        if verdict is None or not verdict.confident or _same_joints(verdict.solution, best):
            return place
        values, rates = joints_in(place.frames, found.mapping, states, fps)
        verdict = with_joints(verdict, best, found.robot, values, rates, RobotPictures(place.pictures))
        return replace(place, verdict=verdict, joints=verdict.solution.values(values, rates))

    return replace(found, places={key: [again(place) for place in places] for key, places in found.places.items()})


def _same_joints(one: Solution, other: Solution) -> bool:
    return one.lag_s == other.lag_s and all(
        np.array_equal(getattr(one, name), getattr(other, name)) for name in ("offset", "scale")
    )


def places_of(source: LeRobotDatasetMetadata, key: str, episodes: Sequence[int]) -> list[list[int]]:
    """Episodes by where a camera stood: each group in one place, the first group where it stood first.

    It is told by the first and last picture of each episode; those that cannot be read, and those that end elsewhere
    than they begin, are in none.
    """
    places: list[tuple[Any, list[int]]] = []
    for index in episodes:
        try:
            rows = read_rows(source, index)
            first, *others = read_colour(source, index, key, rows, sorted({0, len(rows) - 1}))
        except EpisodeError as error:
            logger.info("%s", error)
            continue
        if others and is_displaced(first, others[-1]):
            continue
        for picture, group in places:
            if not is_displaced(picture, first):
                group.append(index)
                break
        else:
            places.append((first, [index]))
    return [group for _, group in places]


def joints_in(
    frames: Frames, mapping: JointMap, states: States, fps: int | float
) -> tuple[Float64[ndarray, "k j"], Float64[ndarray, "k j"]]:
    """Values of the joints in some frames (rad, m), and their change per second."""
    values, rates = [], []
    for index, chosen in frames.items():
        course = mapping.values(states[index])
        values.append(course[chosen])
        rates.append(np.gradient(course, 1 / fps, axis=0)[chosen] if len(course) > 1 else 0 * course[chosen])
    return np.concatenate(values), np.concatenate(rates)


def summary(verdict: Verdict) -> str:
    """The camera in a line."""
    pose = verdict.solution.pose
    fov = math.degrees(2 * math.atan(0.5 / pose.focal))
    return (
        f"{pose.distance:.3f} m from the robot, field of view {fov:.1f} degrees; {verdict.hits:.0%} of the outlines on "
        f"edges, next best camera {verdict.margin:.0%} behind; {verdict.seconds:.0f} s"
    )


def _some(episodes: Sequence[int], count: int) -> list[int]:
    return [episodes[int(k)] for k in evenly(len(episodes), count)]


def described(source: LeRobotDatasetMetadata, config: RobotConfig) -> Robot:
    """The robot of a dataset.

    Raises:
        ConfigError: its description cannot be had.
    """
    found = find_description(config.urdf, config.name, source.info.robot_type)
    return load_robot(found.urdf, found.licence, cache_folder("robots"))


def joints_of(source: LeRobotDatasetMetadata, robot: Robot, states: States, config: RobotConfig) -> JointMap:
    """Which number of the state is which joint.

    Raises:
        ConfigError: the state is not that of the robot's joints.
    """
    every = np.concatenate(list(states.values()))
    return map_joints(robot, names_of_state(source), every, config.units, config.joints)


def states_of(source: LeRobotDatasetMetadata, episodes: Sequence[int]) -> States:
    """What is recorded of the joints in the episodes that can be read.

    Raises:
        DatasetError: nothing is.
    """
    if OBS_STATE not in source.features:
        raise DatasetError(f"{source.repo_id} has no {OBS_STATE}; expected the joint angles in it")
    states = {}
    for index in episodes:
        with contextlib.suppress(EpisodeError):
            values = values_of(read_rows(source, index), OBS_STATE, source.features[OBS_STATE])
            states[index] = values.astype(np.float64).reshape(len(values), -1)
    if not states:
        raise DatasetError(f"{source.repo_id}: none of the episodes tells where its cameras stand")
    return states


def names_of_state(source: LeRobotDatasetMetadata) -> list[str] | None:
    """Of the state's numbers, which some datasets wrap in a list or under a heading."""
    listed = source.features[OBS_STATE].get("names")
    while isinstance(listed, list | tuple | dict) and len(listed) == 1:
        inner = next(iter(listed.values() if isinstance(listed, dict) else listed))
        if not isinstance(inner, list | tuple | dict):
            break
        listed = inner
    return [str(name) for name in listed] if isinstance(listed, list | tuple | dict) else None


def _spread(robot: Robot, mapping: JointMap, states: States, count: int) -> Frames:
    """The frames of each episode in which the robot stands most differently."""
    places = [(index, frame) for index, part in states.items() for frame in range(len(part))]
    if not places:
        return {}
    looked_at = evenly(len(places), FRAMES_LOOKED_AT).numpy()
    values = mapping.values(np.concatenate(list(states.values()))[looked_at])
    chosen: Frames = {}
    for place in spread_frames(surface(robot, values), count):
        index, frame = places[int(looked_at[place])]
        chosen.setdefault(index, []).append(frame)
    return {index: sorted(frames) for index, frames in sorted(chosen.items())}


def _pictures(source: LeRobotDatasetMetadata, key: str, frames: Frames) -> tuple[Frames, UInt8[ndarray, "k h w 3"]]:
    """Frames of a camera, at most 320 wide, of the episodes in which they can be read."""
    readable: Frames = {}
    pictures = []
    for index, chosen in frames.items():
        try:
            pictures += small_pictures(source, index, key, read_rows(source, index), chosen)
        except EpisodeError as error:
            logger.info("%s", error)
            continue
        readable[index] = chosen
    return readable, np.stack(pictures) if pictures else np.zeros((0, 1, 1, 3), np.uint8)


def small_pictures(
    source: LeRobotDatasetMetadata, episode: int, key: str, rows: pa.Table, frames: Sequence[int]
) -> list[UInt8[ndarray, "h w 3"]]:
    """Frames of a camera, at most 320 wide.

    Raises:
        EpisodeError: they cannot be read.
    """
    rgb = read_colour(source, episode, key, rows, frames).numpy()
    height, width = rgb.shape[1:3]
    size = (min(width, REFERENCE_WIDTH), round(height * min(1.0, REFERENCE_WIDTH / width)))
    return [cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in rgb]


def _mappings(robot: Robot, mapping: JointMap, states: States, config: RobotConfig) -> list[JointMap]:
    """What the joints can be: values within 100 may be degrees, or shares of each joint's range."""
    largest = max(float(np.abs(state).max()) for state in states.values())
    if config.units != "auto" or mapping.units != "degrees" or largest > NORMALISED:
        return [mapping]
    return [mapping, in_units(robot, mapping, "normalised")]


def _solved(robot: Robot, mapping: JointMap, place: Place, states: States, fps: int | float) -> Place:
    if len(place.pictures) < MIN_FRAMES:
        return place
    values, rates = joints_in(place.frames, mapping, states, fps)
    verdict = solve(robot, values, rates, RobotPictures(place.pictures))
    return replace(place, verdict=verdict, joints=verdict.solution.values(values, rates))


def _entry(verdict: Verdict, feature: dict[str, Any]) -> dict[str, Any]:
    """K, R, t, and what is known of their errors."""
    height, width, _ = picture_size(feature)
    pose, covariance = verdict.solution.pose, verdict.solution.covariance
    focal = pose.focal * width
    return {
        "K": [[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]],
        "R": pose.rotation.tolist(),
        "t": pose.translation.tolist(),
        "covariance": None if covariance is None else covariance.tolist(),
        "hits": verdict.hits,
        "margin": verdict.margin,
    }
