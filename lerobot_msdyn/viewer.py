"""Command line: look at an episode, its priors, its scene and its new views in Rerun, on one timeline.

python -m lerobot_msdyn.viewer --repo local/ds --episode 0 [--scenes FOLDER] [--web | --save FILE.rrd]
"""

import logging
import os
import socket
import sys
import threading
import urllib.parse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_msdyn.core.cli import EXIT_OK, parse_config, run_command
from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.errors import ConfigError, DatasetError, MsdynError, OutputError
from lerobot_msdyn.core.fields import MAX_INDEX, between
from lerobot_msdyn.core.perturbation import check_pose
from lerobot_msdyn.dataset.named import check_there, output_folder
from lerobot_msdyn.scene.folders import list_scenes

if TYPE_CHECKING:
    import rerun as rr

    from lerobot_msdyn.core.cameras import CameraTrack
    from lerobot_msdyn.core.observations import View
    from lerobot_msdyn.dataset.select import Listing
    from lerobot_msdyn.priors import Priors
    from lerobot_msdyn.scene.store import SavedScene

logger = logging.getLogger(__name__)

COMMAND = "python -m lerobot_msdyn.viewer"
ALIASES = {"repo": "repo_id"}
MAX_PORT = 65535
SERVED_MEMORY = "50%"  # of this machine's, at most, for what a browser may still ask for
FRUSTUM_SHARE = 0.15  # length of a frustum as a share of the look-at distance
GOLDEN = 0.618034  # of the circle of hues, from one index to the next


@dataclass
class ViewerConfig(Recipe):
    """`python -m lerobot_msdyn.viewer`: look at an episode, its scene and its new views in Rerun."""

    # Source dataset (alias: --repo).
    repo_id: str = ""
    # Exact folder of the source dataset; default: LeRobot's home, then the hub.
    root: Path | None = None
    # The episode to show.
    episode: int = between(0, 0, MAX_INDEX)
    # Output of `augment --save_scenes true`, a folder or a name; without it the episode is fitted first.
    scenes: Path | None = None
    # Show it in a browser tab, served by this machine until Ctrl-C; also done where there is no display for a window.
    web: bool = False
    # Port of the page; the data come by --data_port.
    web_port: int = between(9090, 1, MAX_PORT)
    # Port of the data.
    data_port: int = between(9876, 1, MAX_PORT)
    # A .rrd file to write instead of opening a window.
    save: Path | None = None


def run(arguments: list[str]) -> int:
    """Show or save an episode; returns the exit code."""
    config = parse_config(ViewerConfig, arguments, ALIASES, command=COMMAND)
    if not config.repo_id:
        raise ConfigError(f"which dataset? {COMMAND} --repo NAME [--root FOLDER] (see --help)")
    check_there(config.repo_id, config.root)
    from lerobot_msdyn.dataset.metadata import described  # needs neither LeRobot nor torch, which take long
    from lerobot_msdyn.priors.files import check_files

    check_pose(config.perturbation)
    meta = described(config.repo_id, config.root)
    if meta is not None:
        _chosen(config, meta)
    check_files(config.camera, config.priors)
    try:
        import rerun as rr
    except ImportError as error:
        raise MsdynError("Rerun is not installed; get it with: pip install 'lerobot_msdyn[viz]'") from error
    if config.save is not None and not config.save.parent.is_dir():
        raise OutputError(f"--save {config.save}: no folder {config.save.parent}")
    stream = rr.RecordingStream("lerobot_msdyn")
    if config.save is not None:
        stream.save(config.save)
        show_episode(config, stream)
        stream.flush()
        size_mb = config.save.stat().st_size / 1e6
        sys.stdout.write(f"{config.save}  {size_mb:.0f} MB; open it with: rerun {config.save}\n")
    elif config.web or not _has_display():
        _serve(config, stream)
        show_episode(config, stream)
        stream.flush()
        _wait()
    else:
        stream.spawn()
        show_episode(config, stream)
        stream.flush()
    return EXIT_OK


def _chosen(config: ViewerConfig, meta: "Listing") -> tuple[int, list[str], dict[str, Path] | None]:
    """The episode, its cameras, and their kept scenes where --scenes names some."""
    from lerobot_msdyn.dataset.select import select_cameras, select_episodes

    (index,) = select_episodes(meta, [config.episode])
    cameras = select_cameras(meta, config.cameras)
    if config.scenes is None:
        return index, cameras, None
    saved = list_scenes(output_folder(config.scenes)).get(index, {})
    cameras = [key for key in cameras if key in saved]
    if not cameras:
        raise DatasetError(f"{config.scenes}: no saved scene of episode {index} of {meta.repo_id}")
    return index, cameras, saved


def _has_display() -> bool:
    """Whether a window can be opened."""
    return not sys.platform.startswith("linux") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _serve(config: ViewerConfig, stream: "rr.RecordingStream") -> None:
    """Serve what is logged, and a page that shows it.

    Raises:
        OutputError: a port is taken.
    """
    import rerun as rr

    ports = (config.web_port, config.data_port)
    try:
        for port in ports:  # Rerun reports a taken port only later, in a thread of its own
            with socket.socket() as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(("", port))
        data = stream.serve_grpc(grpc_port=config.data_port, server_memory_limit=SERVED_MEMORY)
        rr.serve_web_viewer(web_port=config.web_port, open_browser=_has_display(), connect_to=data)
    except (RuntimeError, ValueError, OSError) as error:
        raise OutputError(
            f"nothing can be served on port {port}: {error}; choose others by --web_port and --data_port, or write a "
            "file by --save FILE.rrd"
        ) from error
    page = f"http://localhost:{config.web_port}/?url={urllib.parse.quote(data, safe='')}"
    forwarded = " ".join(f"-L {port}:localhost:{port}" for port in ports)
    sys.stdout.write(f"open {page}\nfrom another machine, first: ssh {forwarded} THIS_MACHINE\n")
    sys.stdout.flush()


def _wait() -> None:
    """Until Ctrl-C."""
    sys.stdout.write("all frames are there; Ctrl-C ends\n")
    sys.stdout.flush()
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        sys.stdout.write("\n")


def show_episode(config: ViewerConfig, stream: "rr.RecordingStream") -> None:
    """Log one episode, camera by camera.

    Raises:
        ConfigError: the perturbation needs what is not kept with scenes.
        DatasetError: there is no such dataset or episode, or the scenes hold none of it.
    """
    from lerobot_msdyn.dataset.read import open_source, read_episode
    from lerobot_msdyn.priors import estimate_priors
    from lerobot_msdyn.scene import store

    check_pose(config.perturbation)
    source = open_source(config.repo_id, config.root)
    index, cameras, saved = _chosen(config, source)
    episode = read_episode(source, index, cameras, config.camera, recorded_depth=config.priors.reads_recorded_depth)
    small = {key: view.shrunk(config.fit.max_width) for key, view in episode.views.items()}
    for key, view in episode.views.items():
        others = [other for name, other in small.items() if name != key]
        if saved is None:
            seen, scene = small[key], _reconstructed(config, source, index, key, episode.views)
        else:
            scene = store.load(saved[key])  # its camera may move
            height, width = small[key].rgb.shape[1:3]
            seen = replace(small[key], camera=scene.camera.resized(width, height))
        priors = estimate_priors(
            seen, config.priors, config.camera, others=others, episode=index, key=key, device=config.device
        )
        log = _Log(stream, key.rsplit(".", 1)[-1], episode.fps)
        _log_source(log, view, priors)
        _log_gaussians(log, scene)
        _log_camera(log, "source", scene.camera, scene.distance)
        for variant in range(config.variants):
            _log_new_view(log, config, scene, variant)
    stream.send_blueprint(_blueprint([key.rsplit(".", 1)[-1] for key in cameras], config.variants))


def _reconstructed(config: ViewerConfig, source: Any, index: int, key: str, views: dict[str, "View"]) -> "SavedScene":
    """The scene of a camera, fitted now."""
    from lerobot_msdyn.reconstruction.reconstruct import reconstruct
    from lerobot_msdyn.scene.store import SceneSource

    others = [other for name, other in views.items() if name != key]
    logger.info("fitting %s; saved scenes are shown at once (--scenes)", key)
    reconstruction = reconstruct(views[key], config, others=others, episode=index, key=key)
    return reconstruction.saved(SceneSource(source.repo_id, index, key, source.fps))


class _Log:
    """Entities of one camera, by frame."""

    def __init__(self, stream: "rr.RecordingStream", root: str, fps: int | float) -> None:
        self.stream, self.root, self.fps = stream, root, fps

    def at(self, frame: int, path: str, what: Any) -> None:
        self.stream.set_time("frame", sequence=frame)
        self.stream.set_time("time", duration=frame / self.fps)
        self.stream.log(f"{self.root}/{path}", what)

    def always(self, path: str, what: Any) -> None:
        self.stream.log(f"{self.root}/{path}", what, static=True)


def _log_source(log: _Log, view: "View", priors: "Priors") -> None:
    """The video and its priors."""
    import rerun as rr

    tracks = priors.tracks
    colours = _colours(tracks.instance.numpy())
    for frame in range(len(view.rgb)):
        log.at(frame, "source/video", rr.Image(view.rgb[frame].numpy()).compress(jpeg_quality=90))
        log.at(frame, "priors/instances/masks", rr.SegmentationImage(priors.instances[frame].numpy()))
        log.at(frame, "priors/depth", rr.DepthImage(priors.depth[frame].numpy(), meter=1.0))
        visible = tracks.visible[:, frame].numpy()
        log.at(
            frame, "priors/instances/tracks",
            rr.Points2D(tracks.xy[:, frame].numpy()[visible], colors=colours[visible], radii=1.0),
        )  # fmt: skip


def _log_gaussians(log: _Log, scene: "SavedScene") -> None:
    """The static set once per window; the moving one at every frame, in its own colours and in those of its levels."""
    import rerun as rr

    from lerobot_msdyn.scene.ply import gaussians_at

    for start, window in zip(scene.starts, scene.windows, strict=True):
        static, count = window.static, len(window.static)
        log.at(start, "world/static", _points(static.means, static.rgb, static.scales))
        by_level = {
            f"level_{number}": _colours(index.gather(1, logit.argmax(1, keepdim=True))[:, 0].numpy())
            for number, (index, logit) in enumerate(zip(window.indices, window.logits, strict=True))
        }
        for frame in range(window.frames):
            moving = gaussians_at(window.without_patches(), frame).select(slice(count, None))
            log.at(start + frame, "world/moving/points", _points(moving.means, moving.rgb, moving.scales))
            log.at(
                start + frame, "world/moving/ellipsoids",
                rr.Ellipsoids3D(
                    centers=moving.means.numpy(),
                    half_sizes=moving.scales.numpy(),
                    quaternions=moving.quats[:, [1, 2, 3, 0]].numpy(),
                    colors=_bytes(moving.rgb),
                    fill_mode="solid",
                ),
            )  # fmt: skip
            patch = window.patch(frame)
            if patch is not None:
                lasting, single = slice(patch.short_lived), slice(patch.short_lived, None)
                for name, rows in (("short_lived", lasting), ("overlay", single)):
                    points = _points(patch.means[rows], patch.rgb[rows], patch.log_scales[rows].exp())
                    log.at(start + frame, f"world/{name}", points)
            for name, colours in by_level.items():
                log.at(start + frame, f"world/motion/{name}", rr.Points3D(moving.means.numpy(), colors=colours))


def _points(means: Any, rgb: Any, scales: Any) -> Any:
    import rerun as rr

    return rr.Points3D(means.numpy(), colors=_bytes(rgb), radii=scales.median(dim=-1).values.numpy())


def _log_camera(log: _Log, name: str, camera: "CameraTrack", distance: float) -> None:
    """A frustum; a camera that stands still is logged once."""
    import rerun as rr

    for frame in range(1 if camera.is_static else len(camera)):
        pose, intrinsics = camera.world_from_camera[frame].numpy(), camera.intrinsics[frame].numpy()
        path = f"world/cameras/{name}"
        log.at(frame, path, rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
        log.at(
            frame, path,
            rr.Pinhole(
                image_from_camera=intrinsics,
                width=camera.width,
                height=camera.height,
                image_plane_distance=FRUSTUM_SHARE * distance,
            ),
        )  # fmt: skip


def _log_new_view(log: _Log, config: ViewerConfig, scene: "SavedScene", variant: int) -> None:
    """One new camera as the recipe samples it (before any bound), its pictures, and how opaque they are."""
    import rerun as rr
    import torch

    from lerobot_msdyn.training.live import LiveScene
    from lerobot_msdyn.views.camera_change import sample_change

    source = scene.source
    change = sample_change(config.perturbation, {source.camera: scene}, config.seed, source.episode, variant)
    camera = change.cameras()[source.camera]
    _log_camera(log, f"new_{variant}", camera, scene.distance)
    live = LiveScene(scene)
    for frame in range(len(scene)):
        pictures = live.render(camera.select([frame]), torch.tensor([frame]))
        log.at(frame, f"new_{variant}/rendered", rr.Image(pictures.rgb[0].transpose(1, 2, 0)).compress(jpeg_quality=90))
        log.at(frame, f"new_{variant}/coverage", rr.Image((255 * pictures.alpha[0]).round().astype(np.uint8)))


def _colours(indices: np.ndarray) -> np.ndarray:
    """A colour per index, far apart for neighbouring ones (golden angle), uint8 [n, 3]."""
    import cv2

    hues = (indices.astype(np.int64) * GOLDEN % 1.0 * 180).astype(np.uint8)
    hsv = np.stack((hues, np.full_like(hues, 200), np.full_like(hues, 240)), axis=-1)
    return np.asarray(cv2.cvtColor(hsv[None], cv2.COLOR_HSV2RGB)[0])


def _bytes(rgb: Any) -> np.ndarray:
    return np.asarray((rgb.clamp(0, 1) * 255).round().numpy().astype(np.uint8))


def _blueprint(cameras: list[str], variants: int) -> Any:
    """Per camera the scene beside its pictures."""
    import rerun.blueprint as rrb

    tabs = []
    for name in cameras:
        pictures = [
            rrb.Spatial2DView(origin=f"{name}/{path}", name=path)
            for path in ("source/video", "priors/instances", "priors/depth")
        ] + [
            rrb.Spatial2DView(origin=f"{name}/new_{variant}/{path}", name=f"new {variant}: {path}")
            for variant in range(variants)
            for path in ("rendered", "coverage")
        ]
        shown = [f"+ /{name}/world/**", f"- /{name}/world/motion/**", f"- /{name}/world/moving/ellipsoids"]
        space = rrb.Tabs(
            rrb.Spatial3DView(origin=f"{name}/world", name="scene", contents=shown),
            rrb.Spatial3DView(origin=f"{name}/world", name="levels of motion", contents=[f"+ /{name}/world/motion/**"]),
            rrb.Spatial3DView(
                origin=f"{name}/world", name="ellipsoids", contents=[f"+ /{name}/world/moving/ellipsoids"]
            ),
        )
        tabs.append(rrb.Horizontal(space, rrb.Grid(*pictures), column_shares=[3, 4], name=name))
    return rrb.Blueprint(rrb.Tabs(*tabs), rrb.TimePanel(state="collapsed"))


def main() -> None:
    """Entry point."""
    run_command(run)


if __name__ == "__main__":
    main()
