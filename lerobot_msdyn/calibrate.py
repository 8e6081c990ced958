"""Command line: where the cameras of a robot stand, by its joints and what moves in its videos.

python -m lerobot_msdyn.calibrate --repo local/ds --robot.name so101 --out calibration.json
"""

import json
import logging
import math
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_msdyn.core.cli import EXIT_OK, EXIT_SOME_EPISODES_FAILED, parse_config, run_command
from lerobot_msdyn.core.errors import ConfigError, DatasetError, OutputError, PriorError
from lerobot_msdyn.core.fields import between, one_of
from lerobot_msdyn.core.files import cache_folder, write_whole

if TYPE_CHECKING:
    import numpy as np

    from lerobot_msdyn.robots import JointMap, Robot
    from lerobot_msdyn.robots.calibration.solve import Verdict

logger = logging.getLogger(__name__)

COMMAND = "python -m lerobot_msdyn.calibrate"
WIDTH = 320  # px, in which videos are looked at
FRAMES_LOOKED_AT = 3000  # whose states are compared
MIN_FRAMES = 12
SHOWN = 6  # frames of the picture
NORMALISED = 100.5  # largest value of a state that may be in shares of the joints' ranges


@dataclass
class RobotConfig:
    """The robot that the cameras film."""

    # Its description (URDF), with the meshes where it names them.
    urdf: Path | None = None
    # Its name: so101, or one of the package robot_descriptions; default: by the dataset's robot_type.
    name: str = ""
    # Names in observation.state -> joints of the description, where they differ.
    joints: dict[str, str] = field(default_factory=dict)
    # Of the state: auto (told from its values), degrees, radians, normalised (-100..100 of each range) or ticks.
    units: str = one_of("auto", ("auto", "degrees", "radians", "normalised", "ticks"))


@dataclass
class CalibrateConfig:
    """`python -m lerobot_msdyn.calibrate`: pose and focal length of fixed cameras, from the joints and the videos."""

    # Source dataset (alias: --repo).
    repo_id: str = ""
    # Exact folder of the source dataset; default: LeRobot's home, then the hub.
    root: Path | None = None
    # Cameras, by feature key or its last part; default: all but wrist cameras.
    cameras: list[str] | None = None
    # Episodes, e.g. 0 or '[0,3]', during which the cameras stood still; default: all.
    episodes: list[int] | int | None = None
    # At most so many episodes are read, evenly spread.
    max_episodes: int = between(10, 1, 1000)
    # Frames that are looked at, over all episodes.
    frames: int = between(96, MIN_FRAMES, 1000)
    # The calibration file that is written, for --camera.calibration; pictures are written beside it.
    out: Path = Path("calibration.json")
    robot: RobotConfig = field(default_factory=RobotConfig)


ALIASES = {"repo": "repo_id"}


def run(arguments: list[str]) -> int:
    """Calibrate, write and show; returns the exit code."""
    config = parse_config(CalibrateConfig, arguments, ALIASES, command=COMMAND)
    if not config.repo_id:
        raise ConfigError(f"--repo is missing; expected: {COMMAND} --repo NAME [--root FOLDER] [--robot.name so101]")
    from lerobot_msdyn.dataset.read import open_source
    from lerobot_msdyn.dataset.select import select_cameras, select_episodes
    from lerobot_msdyn.robots import find_description, load_robot

    source = open_source(config.repo_id, config.root)
    found = find_description(config.robot.urdf, config.robot.name, source.info.robot_type)
    robot = load_robot(found.urdf, found.licence, cache_folder("robots"))
    keys = select_cameras(source, config.cameras)
    wanted = [config.episodes] if isinstance(config.episodes, int) else config.episodes
    states = _states(source, select_episodes(source, wanted), config)
    mapping, chosen = _chosen(robot, source, states, config)
    pictures = {key: _pictures(source, key, chosen) for key in keys}
    mapping, verdicts = _best(robot, source, pictures, chosen, _mappings(robot, mapping, states, config), states)
    entries: dict[str, Any] = {}
    for key, verdict in verdicts.items():
        values, rates = _values(mapping, states, chosen, source.fps)
        picture = config.out.with_name(f"{config.out.stem}_{key.rsplit('.', 1)[-1]}.png")
        _show(robot, verdict, pictures[key], verdict.solution.values(values, rates), picture)
        sys.stdout.write(f"{key}  {_summary(verdict)}\n{picture}\n")
        if verdict.doubt:
            logger.error("%s is left out: %s; look at %s", key, verdict.doubt, picture)
        else:
            entries[key] = _entry(verdict, source.features[key])
    if not entries:
        raise PriorError(f"{config.repo_id}: no camera could be told by {robot.name}'s joints: nothing was written")
    _write(config.out, {"cameras": entries, "robot": _record(robot, mapping, [verdicts[key] for key in entries])})
    sys.stdout.write(f"{config.out}\n")
    return EXIT_OK if len(entries) == len(keys) else EXIT_SOME_EPISODES_FAILED


def _states(source: Any, episodes: list[int], config: CalibrateConfig) -> dict[int, "np.ndarray"]:
    """State of each episode that is read.

    Raises:
        DatasetError: the dataset has none.
    """
    import numpy as np

    from lerobot_msdyn.core.sampling import evenly
    from lerobot_msdyn.dataset.rows import read_rows

    name = "observation.state"
    if name not in source.features:
        raise DatasetError(f"{source.repo_id} has no {name}; expected the joint angles in it")
    read = [episodes[int(k)] for k in evenly(len(episodes), config.max_episodes)]
    states = {}
    for index in read:
        rows = read_rows(source, index)[name].to_pylist()
        states[index] = np.stack([np.atleast_1d(np.asarray(row, np.float64)) for row in rows])
    return states


def _chosen(
    robot: "Robot", source: Any, states: dict[int, "np.ndarray"], config: CalibrateConfig
) -> tuple["JointMap", dict[int, list[int]]]:
    """How joints follow from states, and the frames of each episode in which the robot stands most differently."""
    import numpy as np

    from lerobot_msdyn.core.sampling import evenly
    from lerobot_msdyn.robots import map_joints
    from lerobot_msdyn.robots.calibration.frames import spread_frames, surface

    state = np.concatenate(list(states.values()))
    names = source.features["observation.state"].get("names")
    listed = next(iter(names.values())) if isinstance(names, dict) and len(names) == 1 else names
    names = [str(name) for name in listed] if isinstance(listed, list | tuple | dict) else None
    mapping = map_joints(robot, names, state, config.robot.units, config.robot.joints)
    places = [(index, frame) for index, part in states.items() for frame in range(len(part))]
    looked_at = evenly(len(places), FRAMES_LOOKED_AT).numpy()
    spread = spread_frames(surface(robot, mapping.values(state[looked_at])), config.frames)
    if len(spread) < MIN_FRAMES:
        raise DatasetError(f"{source.repo_id}: {len(spread)} frames; expected at least {MIN_FRAMES}: add episodes")
    chosen: dict[int, list[int]] = {}
    for place in spread:
        index, frame = places[int(looked_at[place])]
        chosen.setdefault(index, []).append(frame)
    return mapping, {index: sorted(frames) for index, frames in sorted(chosen.items())}


def _pictures(source: Any, key: str, chosen: dict[int, list[int]]) -> "np.ndarray":
    """The chosen frames of a camera, at most `WIDTH` wide."""
    import cv2
    import numpy as np

    from lerobot_msdyn.dataset.read import read_colour
    from lerobot_msdyn.dataset.rows import read_rows

    pictures = []
    for index, frames in chosen.items():
        rgb = read_colour(source, index, key, read_rows(source, index), frames).numpy()
        height, width = rgb.shape[1:3]
        size = (min(width, WIDTH), round(height * min(1.0, WIDTH / width)))
        pictures += [cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in rgb]
    return np.stack(pictures)


def _values(
    mapping: "JointMap", states: dict[int, "np.ndarray"], chosen: dict[int, list[int]], fps: int | float
) -> tuple["np.ndarray", "np.ndarray"]:
    """Values of the joints in the chosen frames, and their change per second."""
    import numpy as np

    values, rates = [], []
    for index, frames in chosen.items():
        course = mapping.values(states[index])
        values.append(course[frames])
        rates.append(np.gradient(course, 1 / fps, axis=0)[frames] if len(course) > 1 else 0 * course[frames])
    return np.concatenate(values), np.concatenate(rates)


def _mappings(
    robot: "Robot", mapping: "JointMap", states: dict[int, "np.ndarray"], config: CalibrateConfig
) -> list["JointMap"]:
    """What the joints can be: values within 100 may be degrees, or shares of each joint's range."""
    import numpy as np

    from lerobot_msdyn.robots.mapping import in_units

    state = np.concatenate(list(states.values()))
    if config.robot.units != "auto" or mapping.units != "degrees" or float(np.abs(state).max()) > NORMALISED:
        return [mapping]
    return [mapping, in_units(robot, mapping, "normalised")]


def _best(
    robot: "Robot",
    source: Any,
    pictures: dict[str, "np.ndarray"],
    chosen: dict[int, list[int]],
    mappings: list["JointMap"],
    states: dict[int, "np.ndarray"],
) -> tuple["JointMap", dict[str, "Verdict"]]:
    """The cameras, by the first of the mappings that fits well, else by the one that fits best."""
    from lerobot_msdyn.priors.masks.robot import RobotPictures
    from lerobot_msdyn.robots.calibration.solve import GOOD_HITS, solve

    tried = []
    for mapping in mappings:
        values, rates = _values(mapping, states, chosen, source.fps)
        verdicts = {key: solve(robot, values, rates, RobotPictures(frames)) for key, frames in pictures.items()}
        share = max(verdict.hits for verdict in verdicts.values())
        tried.append((share, mapping, verdicts))
        if share >= GOOD_HITS:
            break
        logger.info("joints in %s: %.0f %% of the outlines lie on edges", mapping.units, 100 * share)
    _, mapping, verdicts = max(tried, key=lambda item: item[0])
    return mapping, verdicts


def _summary(verdict: "Verdict") -> str:
    pose = verdict.solution.pose
    fov = math.degrees(2 * math.atan(0.5 / pose.focal))
    return (
        f"{pose.distance:.3f} m from the robot, field of view {fov:.1f} degrees; {verdict.hits:.0%} of the outlines on "
        f"edges, next best camera {verdict.margin:.0%} behind; {verdict.seconds:.0f} s"
    )


def _entry(verdict: "Verdict", feature: dict[str, Any]) -> dict[str, Any]:
    """K, R, t, and what is known of their errors."""
    from lerobot_msdyn.dataset.checks import picture_size

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


def _record(robot: "Robot", mapping: "JointMap", verdicts: list["Verdict"]) -> dict[str, Any]:
    """The robot, with the joints as the camera with the most hits corrected them."""
    from lerobot_msdyn.robots.calibration.record import RobotRecord

    solution = max(verdicts, key=lambda verdict: verdict.hits).solution
    corrected = replace(
        mapping, scale=mapping.scale * solution.scale, offset=mapping.offset * solution.scale + solution.offset
    )
    urdf = Path(robot.source).absolute()
    return RobotRecord(urdf, robot.licence, corrected, robot.movable, solution.lag_s).entry()


def _show(robot: "Robot", verdict: "Verdict", frames: "np.ndarray", values: "np.ndarray", path: Path) -> None:
    """Some frames with the links drawn over them.

    Raises:
        OutputError: the picture cannot be written.
    """
    import cv2
    import numpy as np

    from lerobot_msdyn.robots.calibration.contours import Posed

    height, width = frames.shape[1:3]
    size = (2 * width, 2 * height)
    shown = np.linspace(0, len(frames) - 1, SHOWN).astype(int)
    posed = Posed(robot, values[shown])
    drawn = []
    for k, frame in enumerate(shown):
        _, link = posed.drawn(k, verdict.solution.pose, width, height)
        large = cv2.resize(frames[frame], size, interpolation=cv2.INTER_CUBIC)[..., ::-1].copy()
        for index in np.unique(link[link >= 0]):
            hue = np.array([[[int(index) * 53 % 180, 255, 255]]], np.uint8)
            colour = cv2.cvtColor(hue, cv2.COLOR_HSV2BGR)[0, 0].tolist()
            region = cv2.resize((link == index).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
            outlines, _ = cv2.findContours(region, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(large, outlines, -1, colour, 1)
        drawn.append(large)
    rows = [np.concatenate(drawn[k : k + 3], axis=1) for k in range(0, SHOWN, 3)]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        written = cv2.imwrite(str(path), np.concatenate(rows))
    except (OSError, cv2.error) as error:
        raise OutputError(f"{path} cannot be written ({error}); choose another place by --out") from error
    if not written:
        raise OutputError(f"{path} cannot be written; choose another place by --out")


def _write(path: Path, content: dict[str, Any]) -> None:
    try:
        write_whole(path, json.dumps(content, indent=1).encode())
    except OSError as error:
        raise OutputError(f"{path} cannot be written ({error}); choose another place by --out") from error


def main() -> None:
    """Entry point."""
    run_command(run)


if __name__ == "__main__":
    main()
