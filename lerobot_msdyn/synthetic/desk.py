"""The furniture: which primitives with which textures stand on the desk, and which body each belongs to."""

from dataclasses import dataclass, field

import numpy as np

from lerobot_msdyn.synthetic import choreography as ch
from lerobot_msdyn.synthetic import textures as paint
from lerobot_msdyn.synthetic.intersect import BOX, CYLINDER, ELLIPSOID, SHEET
from lerobot_msdyn.synthetic.rigid import Triple, from_axes, pose
from lerobot_msdyn.synthetic.textures import Texture


@dataclass(frozen=True)
class Primitive:
    """One shape, fixed in the frame of its body."""

    shape: int
    half: Triple  # m, half extents along its own axes
    side: str  # texture
    top: str  # texture of the faces across its z axis
    body: str = "world"
    body_from_primitive: np.ndarray = field(default_factory=lambda: np.eye(4))
    gloss: float = 0.0
    casts_shadow: bool = True


def _box(
    center: Triple,
    size: Triple,
    side: str,
    top: str | None = None,
    *,
    body: str = "world",
    yaw: float = 0.0,
    gloss: float = 0.0,
) -> Primitive:
    half = (size[0] / 2, size[1] / 2, size[2] / 2)
    return Primitive(BOX, half, side, top or side, body, pose(center, yaw=yaw), gloss)


def _cylinder(
    placed: np.ndarray,
    radius: float,
    height: float,
    side: str,
    top: str | None = None,
    *,
    body: str = "world",
    gloss: float = 0.0,
) -> Primitive:
    return Primitive(CYLINDER, (radius, radius, height / 2), side, top or side, body, placed, gloss)


def _room() -> list[Primitive]:
    """Floor, walls and ceiling (one box seen from inside), the table, a shelf and pictures on the far wall."""
    room = Primitive(
        BOX, (2.0, 2.0, 1.25), "wall", "floor", body_from_primitive=pose((0, -1.45, 0.5)), casts_shadow=False
    )
    table = _box((0, 0.03, -0.02), (1.5, 1.0, 0.04), "table_edge", "table", gloss=0.10)
    pictures = [
        _box((-0.42, 0.545, 0.28), (0.34, 0.012, 0.26), "frame"),
        _box((-0.42, 0.537, 0.28), (0.30, 0.012, 0.22), "poster"),
        _box((0.36, 0.545, 0.30), (0.44, 0.012, 0.30), "frame"),
        _box((0.36, 0.537, 0.30), (0.40, 0.012, 0.26), "checks"),
    ]
    return [room, table, *pictures]


def _robot() -> list[Primitive]:
    """A pedestal, two links, a palm and two fingers; joints are cylinders about the bodies' y axes."""
    x, y = ch.SHOULDER[:2]
    sideways = pose((0, 0, 0), pitch=np.pi / 2)
    shell, motor, link = "shell", "motor", ch.LINK
    fx, fy, fz = (2 * h for h in ch.FINGER)
    parts = [
        _box((x, y, 0.012), (0.15, 0.13, 0.024), motor, gloss=0.2),
        _cylinder(pose((x, y, 0.055)), 0.042, 0.07, shell, gloss=0.15),
        _cylinder(pose((0, 0, -0.022)), 0.036, 0.036, motor, body="turret", gloss=0.2),
        _cylinder(sideways, 0.030, 0.062, motor, body="turret", gloss=0.2),
        _box((0, 0, link / 2), (0.040, 0.044, link - 0.03), "stripe", "shell", body="upper_arm", gloss=0.15),
        _cylinder(sideways @ pose((0, link, 0)), 0.027, 0.058, motor, body="upper_arm", gloss=0.2),
        _box((0, 0, link / 2), (0.034, 0.038, link - 0.03), "stripe", "shell", body="forearm", gloss=0.15),
        _cylinder(pose((0, 0, ch.WRIST), pitch=np.pi / 2), 0.022, 0.05, motor, body="gripper", gloss=0.2),
        _box((0, 0, 0.102), (0.036, 0.034, 0.034), motor, body="gripper", gloss=0.2),
        _box((0, 0, 0.078), (0.082, 0.034, 0.024), shell, body="gripper", gloss=0.15),
    ]
    for name in ("finger_left", "finger_right"):
        parts.append(_box((0, 0, fz / 2 + 0.006), (fx, fy, fz), "finger", body=name, gloss=0.1))
        parts.append(_box((0, 0, 0.008), (fx + 0.0001, fy + 0.002, 0.016), "pad", body=name))
    return parts


def _container() -> list[Primitive]:
    """An open box with a ball inside, its hinged lid and the lid's tab."""
    (cx, cy, _), (hx, hy, hz) = ch.CONTAINER, ch.CONTAINER_HALF
    wall, height = 0.005, 2 * hz
    walls = [
        _box((cx - hx + wall / 2, cy, hz), (wall, 2 * hy, height), "tin", "tin_edge"),
        _box((cx + hx - wall / 2, cy, hz), (wall, 2 * hy, height), "tin", "tin_edge"),
        _box((cx, cy - hy + wall / 2, hz), (2 * hx, wall, height), "tin_front", "tin_edge"),
        _box((cx, cy + hy - wall / 2, hz), (2 * hx, wall, height), "tin", "tin_edge"),
        _box((cx, cy, 0.002), (2 * hx, 2 * hy, 0.004), "tin_edge", "checks"),
    ]
    ball = Primitive(ELLIPSOID, (0.021, 0.021, 0.021), "ball", "ball", body_from_primitive=pose((cx - 0.02, cy, 0.026)))
    lid = _box((0, -hy, 0), (2 * hx + 0.004, 2 * hy + 0.004, 0.007), "tin_edge", "lid", body="lid", gloss=0.1)
    tab = _box((0, ch.TAB[1] + 0.004, 0.0), (0.016, 0.030, 0.007), "pad", body="lid")
    return [*walls, ball, lid, tab]


def _sheet() -> list[Primitive]:
    """The bending sheet and the dowel at its free edge."""
    length, width = ch.SHEET_SIZE
    dowel = _cylinder(pose((0, 0.013, 0), pitch=np.pi / 2), ch.DOWEL_RADIUS, width + 0.035, "dowel", body="dowel")
    return [Primitive(SHEET, (length, width, 0.001), "sheet", "sheet", "sheet"), dowel]


def _mug(x: float, y: float) -> list[Primitive]:
    handle = [
        _box((x + 0.046, y, 0.022), (0.026, 0.010, 0.008), "mug"),
        _box((x + 0.046, y, 0.062), (0.026, 0.010, 0.008), "mug"),
        _box((x + 0.058, y, 0.042), (0.008, 0.010, 0.048), "mug"),
    ]
    return [_cylinder(pose((x, y, 0.042)), 0.036, 0.084, "mug", "coffee", gloss=0.35), *handle]


def _books(rng: np.random.Generator, x: float, y: float) -> list[Primitive]:
    out, height = [], 0.0
    for name, size in (
        ("book_a", (0.19, 0.135, 0.028)),
        ("book_b", (0.17, 0.125, 0.020)),
        ("book_c", (0.15, 0.11, 0.024)),
    ):
        out.append(_box((x, y, height + size[2] / 2), size, name, f"{name}_cover", yaw=rng.uniform(-0.35, 0.35)))
        height += size[2]
    return out


def _pencils(rng: np.random.Generator, x: float, y: float) -> list[Primitive]:
    out = [_cylinder(pose((x, y, 0.045)), 0.032, 0.09, "cup", "motor", gloss=0.2)]
    for k, name in enumerate(("mug", "pad", "can", "dowel")):
        lean = pose((x, y, 0.01), yaw=k * 1.6 + rng.uniform(-0.3, 0.3), pitch=rng.uniform(0.12, 0.22))
        out.append(_cylinder(lean @ pose((0, 0, 0.085)), 0.0042, 0.15, name))
    return out


def _plant(rng: np.random.Generator, x: float, y: float) -> list[Primitive]:
    out = [_cylinder(pose((x, y, 0.035)), 0.042, 0.07, "pot", "soil")]
    for k in range(11):
        lean = rng.uniform(0.25, 1.0)
        stem = pose((x, y, 0.07), yaw=k * 2.4 + rng.uniform(-0.3, 0.3), pitch=lean)
        leaf = (rng.uniform(0.014, 0.020), 0.004, rng.uniform(0.045, 0.062))
        out.append(
            Primitive(ELLIPSOID, leaf, "leaf", "leaf", body_from_primitive=stem @ pose((0, 0, leaf[2])), gloss=0.1)
        )
    return out


def _clutter(rng: np.random.Generator) -> list[Primitive]:
    """Things that never move, each near its place; the seed shifts and swaps them."""

    def near(x: float, y: float) -> tuple[float, float]:
        return x + rng.uniform(-0.015, 0.015), y + rng.uniform(-0.015, 0.015)

    places = [(0.02, 0.37), (0.40, 0.22), (-0.47, 0.20)]
    order = rng.permutation(3)
    tall = [_mug, lambda x, y: _pencils(rng, x, y), lambda x, y: _plant(rng, x, y)]
    out = [part for k in range(3) for part in tall[order[k]](*near(*places[k]))]
    out += _books(rng, *near(0.31, 0.40))
    x, y = near(0.12, 0.34)
    out.append(_cylinder(pose((x, y, 0.06), yaw=rng.uniform(-0.6, 0.6)), 0.032, 0.12, "can", "tin_edge", gloss=0.4))
    x, y = near(-0.06, 0.46)
    out.append(_box((x, y, 0.105), (0.15, 0.05, 0.21), "cereal", "pad", yaw=rng.uniform(-0.3, 0.3)))
    x, y = near(-0.30, 0.03)
    out.append(
        Primitive(
            ELLIPSOID,
            (0.034, 0.034, 0.034),
            "ball",
            "ball",
            body_from_primitive=pose((x, y, 0.034), yaw=rng.uniform(0, 6), pitch=0.5),
            gloss=0.15,
        )
    )
    x, y = near(-0.34, -0.19)
    out.append(_box((x, y, 0.007), (0.14, 0.19, 0.014), "book_b", "notebook", yaw=rng.uniform(-0.1, 0.35)))
    x, y = near(0.03, -0.24)
    pen = pose((x, y, 0.005), yaw=rng.uniform(0.9, 1.4), pitch=np.pi / 2)
    out.append(_cylinder(pen, 0.0048, 0.14, "can", gloss=0.2))
    return out


def _between(start: Triple, stop: Triple, girth: float, texture: str, body: str) -> Primitive:
    """A limb: an ellipsoid whose long axis goes from one place of a body to another."""
    a, b = np.array(start, float), np.array(stop, float)
    along = (b - a) / np.linalg.norm(b - a)
    side = np.cross((0.0, 1.0, 0.0), along)
    side /= np.linalg.norm(side)
    placed = from_axes(side, np.cross(along, side), along, (a + b) / 2)
    half = (girth, girth, float(np.linalg.norm(b - a)) / 2)
    return Primitive(ELLIPSOID, half, texture, texture, body, placed)


def _hand() -> list[Primitive]:
    """A palm with a sleeve towards the person, and fingers of two limbs; each finger's frame lies on its knuckle."""
    across, above = ch.KNUCKLE
    girth = ch.FINGER_GIRTH
    tip = ch.BLOCK_HALF[1] + girth - across  # from the knuckle, outwards
    palm = Primitive(ELLIPSOID, (0.047, 0.040, 0.017), "skin", "skin", "palm", pose((0.0, 0.0, above + 0.004)))
    arm = [
        _between((0.0, 0.0, above), (-0.10, 0.03, above + 0.05), 0.026, "skin", "palm"),
        _between((-0.06, 0.02, above + 0.03), (-0.42, 0.12, above + 0.20), 0.040, "sleeve", "palm"),
    ]
    fingers = []
    for name in ch.SPREAD:
        out = (-1 if name == "thumb" else 1) * tip
        fingers.append(_between((0.0, 0.0, 0.008), (3.5 * out, 0.0, -0.45 * above), girth, "skin", name))
        fingers.append(_between((out, 0.0, -0.36 * above), (out, 0.0, 0.02 - 1.2 * above), girth, "skin", name))
    return [palm, *arm, *fingers]


def _windmill() -> list[Primitive]:
    """A post on a foot, and four vanes of different print, twisted about their arms."""
    x, y, z = ch.HUB
    parts = [
        _cylinder(pose((x, y + 0.022, 0.005)), 0.035, 0.010, "motor", body="stand"),
        _cylinder(pose((x, y + 0.022, z / 2)), 0.005, z, "dowel", body="stand"),
        _cylinder(pose((0, 0.008, 0), pitch=np.pi / 2), 0.010, 0.034, "motor", body="rotor", gloss=0.2),
    ]
    for k, name in enumerate(("sheet", "checks", "cereal", "lid")):
        arm = pose((0, 0, 0), roll=k * np.pi / 2) @ pose((0.058, 0, 0.014)) @ pose((0, 0, 0), pitch=0.45)
        parts.append(Primitive(BOX, (0.050, 0.0015, 0.028), name, name, "rotor", arm))
    return parts


def primitives(rng: np.random.Generator) -> list[Primitive]:
    """Everything that can be in the room."""
    block = Primitive(BOX, ch.BLOCK_HALF, "block_side", "block", body="block", gloss=0.05)
    return [*_room(), *_robot(), *_container(), *_sheet(), block, *_clutter(rng), *_hand(), *_windmill()]


def painted(rng: np.random.Generator) -> dict[str, Texture]:
    """The textures of all primitives, by name."""
    woods = [(186, 140, 96), (160, 118, 84), (204, 164, 118)]
    accents = [(206, 74, 56), (52, 112, 160), (64, 136, 92), (226, 158, 48), (124, 84, 150)]
    accents = [accents[i] for i in rng.permutation(len(accents))]
    cream, dark, white = (238, 228, 206), (46, 46, 52), (240, 238, 234)
    bx, by, _ = (2 * h for h in ch.BLOCK_HALF)
    return {
        "wall": paint.plain(rng, (206, 202, 190), amount=0.035, extent=0.8),
        "floor": paint.plain(rng, (118, 108, 98), amount=0.08, extent=1.0),
        "table": paint.wood(rng, woods[int(rng.integers(3))], (1.5, 1.0), 0.125),
        "table_edge": paint.wood(rng, (132, 96, 66), (1.5, 0.04), 0.04),
        "frame": paint.plain(rng, (70, 56, 46)),
        "poster": paint.label(rng, "ROBOTS", (cream, accents[0], dark), (0.30, 0.22)),
        "checks": paint.checks(rng, ((196, 204, 208), (110, 134, 150)), 0.02),
        "shell": paint.plain(rng, (240, 178, 58), amount=0.04),
        "stripe": paint.stripes(rng, ((240, 178, 58), (240, 178, 58), (44, 44, 50)), (0.06, ch.LINK)),
        "motor": paint.plain(rng, (56, 58, 64), amount=0.10),
        "finger": paint.stripes(rng, ((226, 226, 222), (150, 152, 156)), (0.03, 0.05)),
        "pad": paint.plain(rng, accents[1], amount=0.10),
        "tin": paint.stripes(rng, (accents[2], cream, accents[2]), (0.14, 0.06)),
        "tin_front": paint.label(rng, "BOLTS", (cream, accents[2], white), (0.14, 0.06)),
        "tin_edge": paint.plain(rng, (188, 190, 192), amount=0.05),
        "lid": paint.label(rng, "TOOL BOX", (accents[2], cream, dark), (0.144, 0.104)),
        "sheet": paint.print_sheet(rng, ch.SHEET_SIZE),
        "dowel": paint.wood(rng, (214, 176, 120), (0.08, 0.2), 0.02),
        "mug": paint.stripes(rng, (accents[3], white, accents[3]), (0.113, 0.084)),
        "coffee": paint.plain(rng, (74, 48, 34)),
        "can": paint.label(rng, "SODA", (accents[4], white, accents[4]), (0.1005, 0.12)),
        "cereal": paint.label(rng, "OATS", (accents[3], cream, accents[0]), (0.15, 0.21)),
        "ball": paint.stripes(rng, (accents[0], white, accents[1]), (0.107, 0.07)),
        "cup": paint.checks(rng, (accents[1], cream), 0.0126),
        "pot": paint.plain(rng, (186, 96, 66), amount=0.08),
        "soil": paint.plain(rng, (62, 46, 36), amount=0.25),
        "leaf": paint.plain(rng, (72, 132, 64), amount=0.15, extent=0.05),
        "block": paint.keys(rng, accents[0], (bx, by), 2, 3),
        "block_side": paint.stripes(rng, (accents[0], cream, accents[0]), (0.1, 0.04)),
        "notebook": paint.label(rng, "NOTES", (accents[1], cream, dark), (0.14, 0.19)),
        **{f"book_{k}": paint.stripes(rng, (accents[i], cream), (0.2, 0.028)) for i, k in enumerate("abc")},
        **{
            f"book_{k}_cover": paint.label(rng, word, (accents[i], cream, dark), (0.16, 0.12))
            for i, (k, word) in enumerate(zip("abc", ("OPTICS", "CONTROL", "POEMS"), strict=True))
        },
        "skin": paint.plain(rng, (214, 164, 136), amount=0.08, extent=0.06),
        "sleeve": paint.checks(rng, (accents[1], cream), 0.02),
    }
