"""A camera that is carried over a synthetic desk by a link, and a robot whose link goes the same way."""

from pathlib import Path

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from scipy.spatial.transform import Rotation

from lerobot_msdyn.core.geometry import axis_angle_to_matrix, se3
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.viewpoints import recorded_cameras

FRAMES, WIDTH, HEIGHT, FPS = 36, 160, 120, 10
FOV_DEG = 70.0  # of the synthetic wrist camera
WRIST = "observation.images.wrist"
JOINTS = ("x", "y", "z", "rx", "ry", "rz")
Ridden = tuple[np.ndarray, np.ndarray, np.ndarray]


def carried() -> Ridden:
    """Pictures [t, h, w, 3] of a camera that is carried over the desk, its link's poses, and link from camera."""
    scene = make_scene("static", 0, FRAMES, WIDTH, HEIGHT)
    time = torch.linspace(0, 1, FRAMES, dtype=torch.float64)
    turns = torch.stack((0.15 * (5 * time).sin(), 0.15 * (4 * time).cos(), 0.5 * (3 * time).sin()), dim=1)
    down = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    places = torch.stack((0.10 * (6 * time).sin(), 0.05 + 0.08 * time, 0.40 + 0.06 * (7 * time).cos()), dim=1)
    links = se3(axis_angle_to_matrix(turns) @ down, places).numpy()
    eye = se3(axis_angle_to_matrix(torch.tensor([[0.1, -0.08, 0.6]], dtype=torch.float64))[0], torch.zeros(3).double())
    eye[:3, 3] = torch.tensor([0.03, -0.04, 0.02])
    wrist = recorded_cameras(links, WIDTH, HEIGHT)["wrist"]
    camera = type(wrist)(wrist.intrinsics, torch.from_numpy(links @ eye.numpy()).float(), WIDTH, HEIGHT)
    return scene.render(camera, [0] * FRAMES).rgb.numpy(), links, eye.numpy()


def write_gantry(folder: Path) -> Path:
    """A robot that slides along and turns about the axes of its world, in this order; its last link is `flange`."""
    folder.mkdir(parents=True, exist_ok=True)
    links, joints, parent = ['<link name="base"/>'], [], "base"
    for index, name in enumerate(JOINTS):
        child = "flange" if name == JOINTS[-1] else f"{name}_link"
        kind = "prismatic" if index < 3 else "revolute"
        axis = " ".join("1" if k == index % 3 else "0" for k in range(3))
        shape = '<visual><geometry><box size="0.02 0.02 0.02"/></geometry></visual>' if child == "flange" else ""
        links.append(f'<link name="{child}">{shape}</link>')
        joints.append(
            f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<axis xyz="{axis}"/><limit lower="-4" upper="4" effort="1" velocity="1"/></joint>'
        )
        parent = child
    path = folder / "gantry.urdf"
    path.write_text(f'<robot name="gantry">{"".join(links)}{"".join(joints)}</robot>')
    return path


def write_ridden(root: Path, ridden: Ridden, episodes: int = 2) -> Path:
    """Episodes of the camera on the gantry's flange."""
    rgb, links, _ = ridden
    turns = Rotation.from_matrix(links[:, :3, :3]).as_euler("XYZ")
    state = np.concatenate((links[:, :3, 3], turns), axis=1).astype(np.float32)
    vector = {"dtype": "float32", "shape": (6,), "names": list(JOINTS)}
    features = {
        "observation.state": vector,
        "action": dict(vector),
        WRIST: {"dtype": "image", "shape": (HEIGHT, WIDTH, 3), "names": ["height", "width", "channels"]},
    }
    dataset = LeRobotDataset.create("local/ridden", FPS, features, root=root, use_videos=False)
    for _ in range(episodes):
        for row, picture in zip(state, rgb, strict=True):
            dataset.add_frame({"observation.state": row, "action": row, WRIST: picture, "task": "ride"})
        dataset.save_episode(parallel_encoding=False)
    dataset.finalize()
    return root
