"""Pictures of the simulated SO-101 from any camera, by MuJoCo."""

from pathlib import Path

import mujoco
import numpy as np

from .cameras import FOVY_DEG
from .forms import Form

# As it comes (0.02) a jaw that is 5 mm off lands on it: policies that are told its place fail too.
BLOCK_HALF_WIDTH_M = 0.013
FAR_M = 10.0  # up to which a depth camera sees
# What stands about the workspace of a cluttered scene, in the pictures alone: half sizes and centre (m), colour.
BOXES_M: tuple[tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]], ...] = (
    ((0.02, 1.5, 0.4), (-0.45, 0.0, 0.4), (0.72, 0.68, 0.6)),  # a wall
    ((0.04, 0.05, 0.08), (-0.12, -0.24, 0.08), (0.55, 0.3, 0.2)),
    ((0.03, 0.03, 0.06), (0.1, 0.27, 0.06), (0.25, 0.45, 0.3)),
    ((0.03, 0.05, 0.015), (0.28, -0.26, 0.015), (0.75, 0.75, 0.78)),
    ((0.05, 0.09, 0.02), (-0.2, 0.1, 0.02), (0.5, 0.15, 0.15)),
)
BOTTLE_M = (0.03, 0.07), (-0.08, 0.3, 0.07)  # radius and half height, centre
WRIST_POSITION_M, WRIST_TILT_DEG, WRIST_FOVY_DEG = (0.0, 0.055, -0.03), 25.0, 70.0  # in the gripper's axes


class Scene:
    """The environment's scene with a front camera that can be put anywhere, and a wrist camera."""

    def __init__(self, xml: Path, form: Form) -> None:
        """Compiles the scene; meshes are simplified as the form says."""
        spec = mujoco.MjSpec.from_file(str(xml))
        spec.camera("front").fovy = FOVY_DEG
        spec.geom("block").size[:2] = BLOCK_HALF_WIDTH_M
        tilt = np.radians(WRIST_TILT_DEG) / 2
        spec.body("gripper").add_camera(
            name="wrist", pos=WRIST_POSITION_M, quat=(np.cos(tilt), -np.sin(tilt), 0, 0), fovy=WRIST_FOVY_DEG
        )
        if form.cluttered:
            for size, place, colour in BOXES_M:
                spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=place, rgba=(*colour, 1))
            (radius, half), place = BOTTLE_M
            bottle = {"type": mujoco.mjtGeom.mjGEOM_CYLINDER, "size": (radius, half, 0), "rgba": (0.2, 0.5, 0.6, 1)}
            spec.worldbody.add_geom(**bottle, pos=place)
        if form.mesh_cell_m:
            simplify(spec, mujoco.MjModel.from_xml_path(str(xml)), form.mesh_cell_m)
        self.model = spec.compile()
        self.model.vis.global_.offwidth, self.model.vis.global_.offheight = form.width, form.height
        self.model.vis.quality.shadowsize, self.model.vis.quality.offsamples = form.shadows, form.samples
        self.data = mujoco.MjData(self.model)
        self.renderer = mujoco.Renderer(self.model, form.height, form.width)
        self.front = self.model.camera("front").id

    def pictures(self, qpos: np.ndarray, front: np.ndarray | None = None, *, wrist: bool = False) -> list[np.ndarray]:
        """RGB [h, w, 3] uint8: of the front camera at a world-from-camera pose, then of the wrist camera."""
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        shown = []
        if front is not None:
            self.data.cam_xpos[self.front] = front[:3, 3]
            self.data.cam_xmat[self.front] = (front[:3, :3] * (1, -1, -1)).ravel()  # MuJoCo's are right, up, back
            self.renderer.update_scene(self.data, camera="front")
            shown.append(self.renderer.render())
        if wrist:
            self.renderer.update_scene(self.data, camera="wrist")
            shown.append(self.renderer.render())
        return shown

    def depth_mm(self) -> np.ndarray:
        """z-depth of the front camera's last picture, [h, w, 1] uint16, mm; 0 where it is beyond `FAR_M`."""
        self.renderer.update_scene(self.data, camera="front")
        self.renderer.enable_depth_rendering()
        depth = self.renderer.render().copy()
        self.renderer.disable_depth_rendering()
        return np.where(depth < FAR_M, np.rint(1000 * depth), 0).astype(np.uint16)[..., None]

    def moving(self) -> np.ndarray:
        """Where the front camera's last picture shows the robot or the block, [h, w] bool."""
        self.renderer.update_scene(self.data, camera="front")
        self.renderer.enable_segmentation_rendering()
        geom = self.renderer.render()[..., 0].copy()
        self.renderer.disable_segmentation_rendering()
        of_world = self.model.geom_bodyid == 0  # table and clutter
        return (geom >= 0) & ~of_world[np.maximum(geom, 0)]


def simplify(spec: mujoco.MjSpec, model: mujoco.MjModel, cell_m: float) -> None:
    """Merge the vertices of each mesh within cells of a grid: a picture on a CPU costs what its triangles cost."""
    for mesh in spec.meshes:
        one = model.mesh(mesh.name)
        first, count = int(one.vertadr[0]), int(one.vertnum[0])
        face, faces = int(one.faceadr[0]), int(one.facenum[0])
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.mesh_quat[one.id])  # the compiler puts meshes into their principal axes
        vertices = model.mesh_vert[first : first + count] @ turn.reshape(3, 3).T + model.mesh_pos[one.id]
        vertices, kept = merged(vertices, model.mesh_face[face : face + faces], cell_m)
        mesh.file, mesh.inertia = "", mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        mesh.uservert, mesh.userface = vertices.ravel().tolist(), kept.ravel().tolist()


def merged(vertices: np.ndarray, faces: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [n, 3] merged within cells, each at the mean of its cell's, and the faces [m, 3] that are left."""
    _, cells = np.unique(np.round(vertices / cell).astype(np.int64), axis=0, return_inverse=True)
    cells = cells.reshape(-1)
    count = np.bincount(cells)
    means = np.stack([np.bincount(cells, axis) / count for axis in vertices.T], axis=1)
    faces = cells[faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(1)]
    _, first = np.unique(np.sort(faces, 1), axis=0, return_index=True)
    return means, faces[np.sort(first)]
