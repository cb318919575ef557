"""Two walkers and a ball: closed-form motion at any time, and the primitives they are made of.

Both walk the same ellipse at constant speed, half a lap apart, so that they never meet, cross before
the middle of the camera arc at the middle of the clip, and the ball has the inside of the ellipse.
"""

import dataclasses
import functools

import numpy as np

from fourd.demo.primitives import UP, Builder, frame_around

FIGURE1, FIGURE2, BALL = 1, 2, 3
LABELS = {"figure1": FIGURE1, "figure2": FIGURE2, "ball": BALL}
SPEED_M_S = 1.2
PATH_HALF_AXES = (1.9, 0.95)
GAIT_M = 1.12
STANCE = 0.6
BALL_RADIUS = 0.115
BALL_PERIOD_S, BALL_HEIGHT = 0.66, 0.53


@functools.cache
def _path_table() -> tuple[np.ndarray, np.ndarray]:
    """Arc length and angle along the ellipse, fine enough for 1e-6 m."""
    angle = np.linspace(0, 2 * np.pi, 20_001)
    a, b = PATH_HALF_AXES
    middle = 0.5 * (angle[1:] + angle[:-1])
    step = np.hypot(a * np.sin(middle), b * np.cos(middle)) * (angle[1] - angle[0])
    return np.concatenate([[0.0], np.cumsum(step)]), angle


def path_length() -> float:
    """One lap, metres."""
    return float(_path_table()[0][-1])


def path_point(distance: float) -> tuple[np.ndarray, np.ndarray]:
    """Ground point (3,) and heading (3,) after walking `distance` metres counter-clockwise."""
    lengths, angles = _path_table()
    angle = float(np.interp(distance % lengths[-1], lengths, angles))
    a, b = PATH_HALF_AXES
    heading = np.array([-a * np.sin(angle), b * np.cos(angle), 0.0])
    return np.array([a * np.cos(angle), b * np.sin(angle), 0.0]), heading / np.linalg.norm(heading)


def ball_center(time_s: float) -> np.ndarray:
    """(3,) centre of the ball: parabolic bounces while it sweeps to and fro."""
    phase = time_s / BALL_PERIOD_S % 1.0
    x = 1.35 * np.sin(2.3 * time_s - 1.0)
    y = 0.16 * np.sin(1.7 * time_s + 0.4)
    return np.array([x, y, BALL_RADIUS + BALL_HEIGHT * 4 * phase * (1 - phase)])


def bounce_times(first_s: float, last_s: float) -> np.ndarray:
    """Instants at which the ball touches the ground."""
    return np.arange(np.ceil(first_s / BALL_PERIOD_S), np.floor(last_s / BALL_PERIOD_S) + 1) * BALL_PERIOD_S


@dataclasses.dataclass(frozen=True)
class Style:
    """Who walks: label, size, place on the lap, and material names."""

    label: int
    scale: float
    lap_share: float
    torso: str
    sleeve: str
    forearm: str
    thigh: str
    shin: str
    shoe: str
    skin: str
    head: str
    hair: str
    has_skirt: bool


MAN = Style(
    FIGURE1,
    1.0,
    0.75,
    "plaid",
    "plaid",
    "plaid",
    "denim",
    "denim",
    "leather",
    "skin1",
    "head1",
    "hair1",
    False,
)
WOMAN = Style(
    FIGURE2,
    0.95,
    0.25,
    "dress",
    "dress",
    "skin2",
    "leggings",
    "leggings",
    "sneaker",
    "skin2",
    "head2",
    "hair2",
    True,
)


def walked_distance(style: Style, time_s: float, middle_s: float) -> float:
    """Metres along the lap; at `middle_s` the first figure is in front, the second behind."""
    return style.lap_share * path_length() + SPEED_M_S * (time_s - middle_s)


def _ankle(style: Style, distance: float, side: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Ankle (3,), heading of the foot (3,) and how far the toe points down, radians."""
    offset = 0.0 if side > 0 else 0.5
    cycle = distance / GAIT_M + offset
    step, phase = np.floor(cycle), cycle % 1.0
    # A planted foot stays where the body passes over it at half of the stance.
    planted = (step + 0.5 * STANCE - offset) * GAIT_M
    if phase < STANCE:
        travel, swing = 0.0, 0.0
        lift = 0.06 * _smooth((phase - 0.40) / (STANCE - 0.40))
    else:
        swing = (phase - STANCE) / (1 - STANCE)
        travel = _smooth(swing)
        lift = 0.06 * (1 - travel) + 0.09 * np.sin(np.pi * swing) ** 2
    here, heading = path_point(planted + travel * GAIT_M)
    left = np.cross(UP, heading)
    pitch = 7.0 * lift * (1 - swing) - 0.35 * np.sin(np.pi * swing) * swing
    return here + side * 0.085 * left + UP * (0.085 * style.scale + lift), heading, pitch


def _smooth(x: float) -> float:
    x = min(1.0, max(0.0, x))
    return x * x * (3 - 2 * x)


def _bend(start: np.ndarray, end: np.ndarray, lengths: tuple[float, float], toward: np.ndarray) -> np.ndarray:
    """The joint between two bones of given lengths from start to end, bent toward a direction."""
    reach = end - start
    distance = min(float(np.linalg.norm(reach)), sum(lengths) - 1e-4)
    axis = reach / np.linalg.norm(reach)
    side = toward - np.dot(toward, axis) * axis
    side /= np.linalg.norm(side)
    along = (lengths[0] ** 2 - lengths[1] ** 2 + distance**2) / (2 * distance)
    return start + along * axis + np.sqrt(max(0.0, lengths[0] ** 2 - along**2)) * side


def add_figure(builder: Builder, style: Style, time_s: float, middle_s: float) -> None:
    """Add one walker at a time."""
    distance = walked_distance(style, time_s, middle_s)
    ground, forward = path_point(distance)
    left = np.cross(UP, forward)
    s, phase = style.scale, 2 * np.pi * distance / GAIT_M
    bob = 0.02 * np.cos(2 * phase - 2 * np.pi * STANCE)
    twist = 0.09 * np.cos(phase)
    frames = []
    for turn in (-twist, twist):
        c, sn = np.cos(turn), np.sin(turn)
        frames.append(np.stack([c * forward + sn * left, c * left - sn * forward, UP]))
    hips, chest = frames
    sway = 0.018 * np.sin(phase + 0.4)
    builder.label = style.label

    def place(frame: np.ndarray, x: float, y: float, z: float) -> np.ndarray:
        lean = 0.05 * max(0.0, z - 0.9)
        return ground + (np.array([x + lean, y + sway, 0]) * s) @ frame + UP * (z * s + bob)

    knees = [
        _add_leg(builder, style, place(hips, 0, 0.09 * side, 0.905), distance, side, forward)
        for side in (1, -1)
    ]
    for side in (1, -1):
        _add_arm(builder, style, place(chest, 0, 0.205 * side, 1.375), chest, phase, side)
    _add_trunk(builder, style, place, hips, chest)
    if style.has_skirt:
        _add_skirt(builder, s, place(hips, 0, 0, 1.06), knees, forward)
    _add_head(builder, style, place, chest)
    for x, z, radius in ((0.0, 0.3, 0.16), (0.0, 0.75, 0.2), (0.0, 1.2, 0.24), (0.0, 1.6, 0.13)):
        builder.occluders.append((*place(hips, x, 0, z), radius * s, style.label))
    builder.label = 0


def _add_leg(
    builder: Builder, style: Style, hip: np.ndarray, distance: float, side: int, forward: np.ndarray
) -> np.ndarray:
    """Add thigh, shin and shoe; returns the knee (3,)."""
    s = style.scale
    ankle, heading, pitch = _ankle(style, distance, side)
    knee = _bend(hip, ankle, (0.44 * s, 0.435 * s), forward)
    builder.limb(hip, knee, (0.088 * s, 0.062 * s), style.thigh, forward)
    builder.limb(knee, ankle, (0.060 * s, 0.043 * s), style.shin, forward, uv=(0.38, 1, 0, 0.45))
    toe = np.cos(pitch) * heading - np.sin(pitch) * UP
    down = np.cos(pitch) * UP + np.sin(pitch) * heading
    heel = ankle - 0.045 * s * toe - 0.043 * s * down
    builder.limb(heel, heel + 0.19 * s * toe, (0.043 * s, 0.034 * s), style.shoe, UP)
    builder.occluders.append((*(ankle + 0.04 * toe), 0.11 * s, style.label))
    return knee


def _add_arm(
    builder: Builder, style: Style, shoulder: np.ndarray, chest: np.ndarray, phase: float, side: int
) -> None:
    s = style.scale
    # An arm swings against the leg of its side.
    swing = -0.48 * side * np.cos(phase - 0.3)
    bend = 0.35 + 0.35 * max(0.0, swing)
    out = 0.10 * side

    def direction(angle: float) -> np.ndarray:
        vector = np.array([np.sin(angle), out, -np.cos(angle)]) @ chest
        return vector / np.linalg.norm(vector)

    elbow = shoulder + 0.285 * s * direction(swing)
    wrist = elbow + 0.25 * s * direction(swing + bend)
    front = chest[0]
    builder.limb(shoulder, elbow, (0.058 * s, 0.044 * s), style.sleeve, front)
    builder.limb(elbow, wrist, (0.043 * s, 0.033 * s), style.forearm, front)
    hand = wrist + 0.075 * s * direction(swing + bend + 0.15)
    axes = frame_around(hand - wrist, front)
    builder.ellipsoid(hand, (0.045 * s, 0.028 * s, 0.085 * s), style.skin, axes)


def _add_skirt(
    builder: Builder, scale: float, waist: np.ndarray, knees: list[np.ndarray], forward: np.ndarray
) -> None:
    """A cone of cloth from the waist to below the knees, pushed out by the legs."""
    middle = 0.5 * (knees[0] + knees[1])
    stride = abs(float(np.dot(knees[0] - knees[1], forward)))
    hem = waist + 1.12 * (middle - waist)
    radius = 0.25 * scale
    depth = max(0.8 * radius, 0.5 * stride + 0.105 * scale)
    hips = waist - 0.14 * scale * UP
    builder.ellipsoid(
        hips, (0.152 * scale, 0.19 * scale, 0.19 * scale), "dress", frame_around(UP, forward), (1, 0.5, 0, 0)
    )
    builder.frustum(hem, waist, (radius, 0.125 * scale), "dress", forward, depth / radius)


def _add_trunk(builder: Builder, style: Style, place, hips: np.ndarray, chest: np.ndarray) -> None:
    s = style.scale
    front = chest[0]
    if style.has_skirt:
        builder.limb(
            place(hips, 0, 0, 1.02), place(hips, 0, 0, 1.07), (0.142 * s, 0.138 * s), "belt", front, 0.78
        )
    else:
        builder.ellipsoid(place(hips, 0, 0, 0.94), (0.125 * s, 0.165 * s, 0.13 * s), style.thigh, hips)
        builder.limb(
            place(hips, 0, 0, 0.995), place(hips, 0, 0, 1.02), (0.152 * s, 0.15 * s), "belt", front, 0.74
        )
    low, high = (0.138, 0.155) if style.has_skirt else (0.15, 0.172)
    builder.limb(
        place(chest, 0, 0, 1.08), place(chest, 0, 0, 1.305), (low * s, high * s), style.torso, front, 0.66
    )
    for side in (1, -1):
        builder.ellipsoid(
            place(chest, 0, 0.165 * side, 1.385), (0.068 * s, 0.085 * s, 0.07 * s), style.torso, chest
        )
    builder.limb(
        place(chest, 0, 0, 1.42), place(chest, 0.01, 0, 1.53), (0.056 * s, 0.052 * s), style.skin, front
    )
    if not style.has_skirt:
        builder.box(
            place(chest, -0.20, 0, 1.22), (0.085, 0.15, 0.21), "rucksack", chest, uv=(1, 1, 0.2, 0.25)
        )
        builder.box(place(chest, -0.30, 0, 1.14), (0.03, 0.10, 0.09), "rucksack", chest, uv=(1, 1, 0.2, 0.16))


def _add_head(builder: Builder, style: Style, place, chest: np.ndarray) -> None:
    s, front = style.scale, chest[0]
    center = place(chest, 0.02, 0, 1.635)
    radii = np.array([0.096, 0.080, 0.122]) * s
    builder.ellipsoid(center, radii, style.head, chest, uv=(0.62, 0.36, 0.31, 0.18))
    builder.ellipsoid(center + 0.094 * s * front - 0.012 * s * UP, (0.018, 0.014, 0.022), style.skin, chest)
    for side in (1, -1):
        builder.ellipsoid(center + 0.079 * side * s * chest[1], (0.022, 0.012, 0.032), style.skin, chest)
    if style.has_skirt:
        builder.limb(
            center - 0.045 * s * front + 0.02 * UP,
            center - 0.075 * s * front - 0.22 * s * UP,
            (0.086 * s, 0.06 * s),
            style.hair,
            front,
            0.75,
        )
        brim = center + 0.062 * s * UP
        builder.frustum(brim, brim + 0.016 * UP, (0.20 * s, 0.19 * s), "straw", front)
        builder.limb(brim, brim + 0.05 * UP, (0.098 * s, 0.088 * s), "straw", front)
        builder.limb(brim + 0.012 * UP, brim + 0.03 * UP, (0.102 * s, 0.098 * s), "ribbon", front)
    else:
        builder.ellipsoid(
            center - 0.022 * s * front + 0.03 * s * UP, radii * (0.97, 1.06, 0.93), style.hair, chest
        )


def add_ball(builder: Builder, time_s: float) -> None:
    """Add the ball, spinning about a tilted axis."""
    center = ball_center(time_s)
    axis = np.array([0.35, 0.85, 0.4])
    turn = 9.0 * time_s
    rest = frame_around(axis, [1.0, 0.0, 0.0])
    c, s = np.cos(turn), np.sin(turn)
    spin = np.stack([c * rest[0] + s * rest[1], c * rest[1] - s * rest[0], rest[2]])
    builder.label = BALL
    builder.ellipsoid(center, (BALL_RADIUS,) * 3, "ball", spin, uv=(0.72, 0.36, 0.36, 0.18))
    builder.occluders.append((*center, BALL_RADIUS, BALL))
    builder.label = 0
