"""Place the performer's parts in space and in the image, with their depths for occlusion.

Numbers in this file are metres of an adult. The torso's own axes are those of the body at rest
(`torchpose.demo._mannequin`): x to the person's left, y down, z to the back, from the neck."""

from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from torchpose.demo._performer import Performance
from torchpose.demo._rendering.look import TORSO_TEXTURE, Wardrobe
from torchpose.demo._rendering.paint import (
    Array,
    Box,
    Capsule,
    Sprite,
    paint_capsule,
    paint_polygon,
    paint_sprite,
    place_sprite,
    polygon_alpha,
    polygon_box,
    warp_sprite,
)
from torchpose.math._rotations import euler_to_matrix

Points = NDArray[np.float64]

FACE_FROM_HEAD = (0.0, 0.025, -0.04)
"""Middle of the face's box from the head joint, which is the middle of the head; head's axes."""


class Pose(NamedTuple):
    """Holds one person at one time, camera axes, metres.

    Attributes:
        joints: [8, 3] in the order of `UPPER_BODY`. wrists: left and right [2, 3].
        torso, head: axes of the torso and the head as columns [3, 3].
        upright: the same of the body at rest, which the legs follow.
    """

    joints: Points
    wrists: Points
    torso: Points
    head: Points
    upright: Points

    @property
    def neck(self) -> Points:
        """Return the neck joint [3]."""
        return self.joints[4]

    def on_torso(self, points: Points) -> Points:
        """Return the points of the torso's axes [..., 3] in camera axes."""
        return self.neck + np.asarray(points, np.float64) @ self.torso.T

    def arm(self, side: int) -> Points:
        """Return the shoulder, elbow, wrist and hand [4, 3] of the left (0) or right (1) arm."""
        hand, elbow, shoulder = ((0, 1, 2), (7, 6, 5))[side]
        return np.stack(
            [self.joints[shoulder], self.joints[elbow], self.wrists[side], self.joints[hand]]
        )


class Bodies(NamedTuple):
    """Holds one person over time: the fields of `Pose`, with frames as leading dimension."""

    joints: Points
    wrists: Points
    torso: Points
    head: Points
    upright: Points

    def at(self, frame: float) -> Pose:
        """Return the pose at a time in frames, interpolated; the ends stay."""
        last = len(self.joints) - 1
        time = min(max(frame, 0.0), float(last))
        before = min(int(time), max(last - 1, 0))
        after, share = min(before + 1, last), time - before
        if share == 0:
            return Pose(*(x[before] for x in self))
        # Axes rotate so little between two frames that their mean is nearly a rotation.
        return Pose(*((1 - share) * x[before] + share * x[after] for x in self))


def bodies(performance: Performance) -> Bodies:
    """Return the bodies of a performance."""
    upright = performance.rotation.double()
    torso = upright @ euler_to_matrix(performance.angles.torso.double())
    head = torso @ euler_to_matrix(performance.angles.head.double())
    parts = (performance.joints, performance.wrists, torso, head, upright.expand_as(torso))
    return Bodies(*(torch.as_tensor(x).double().numpy() for x in parts))


class Brush(Protocol):
    """Declares what can be painted on an image."""

    def paint(self, canvas: Array) -> None:
        """Paint on a canvas [H, W, 3]."""
        ...

    def box(self, shape: tuple[int, ...]) -> Box:
        """Return the part of an image that it may cover."""
        ...

    def alpha(self, box: Box) -> Array:
        """Return the opacity in a box."""
        ...

    @property
    def anchors(self) -> Points:
        """Return points that move with the part [N, 2], pixels."""
        ...


class Limb(NamedTuple):
    """Paints a shaded limb."""

    capsule: Capsule
    colour: NDArray
    folds: float = 0.0
    root: float = 0.0

    def paint(self, canvas: Array) -> None:
        paint_capsule(canvas, self.capsule, self.colour, self.folds, self.root)

    def box(self, shape: tuple[int, ...]) -> Box:
        return self.capsule.box(shape)

    def alpha(self, box: Box) -> Array:
        return self.capsule.field(box)[0]

    @property
    def anchors(self) -> Points:
        return np.array([self.capsule.start, self.capsule.end])


class Outline(NamedTuple):
    """Paints a filled outline."""

    points: Points
    texture: Array
    to_image: NDArray

    def paint(self, canvas: Array) -> None:
        paint_polygon(canvas, self.points, self.texture, self.to_image)

    def box(self, shape: tuple[int, ...]) -> Box:
        return polygon_box(self.points, shape)

    def alpha(self, box: Box) -> Array:
        return polygon_alpha(self.points, box)

    @property
    def anchors(self) -> Points:
        return self.points[:: max(len(self.points) // 8, 1)]


class Picture(NamedTuple):
    """Paints a sprite."""

    sprite: Sprite
    place: NDArray
    axes: NDArray

    def paint(self, canvas: Array) -> None:
        paint_sprite(canvas, self.sprite, self.place, self.axes)

    def box(self, shape: tuple[int, ...]) -> Box:
        return place_sprite(shape, self.sprite, self.place, self.axes)[0]

    def alpha(self, box: Box) -> Array:
        shape = (box.bottom, box.right)
        _, level, to_image = place_sprite(shape, self.sprite, self.place, self.axes)
        return warp_sprite(box, level, to_image)[..., 3]

    @property
    def anchors(self) -> Points:
        return np.stack([self.place, self.place + 0.1 * self.axes[:, 0]])


class Part(NamedTuple):
    """Holds a part of a person.

    Attributes:
        name: "head", "neck", "torso", "legs", or "upper_arm", "forearm", "hand" with _left, _right.
        depth: parts are painted in descending order of it, metres. brush: what to paint.
    """

    name: str
    depth: float
    brush: Brush


class Projection:
    """Projects points of camera axes into the image.

    Args:
        K: [3, 3].
    """

    def __init__(self, K: NDArray) -> None:
        self.K = np.asarray(K, np.float64)
        self.focal = float(np.sqrt(abs(self.K[0, 0] * self.K[1, 1])))

    def __call__(self, points: Points) -> Points:
        """Return the pixels [..., 2] of points [..., 3]."""
        homogeneous = points @ self.K.T
        return homogeneous[..., :2] / np.maximum(homogeneous[..., 2:], 0.05)

    def scale(self, point: Points) -> float:
        """Return the pixels for a metre at the depth of a point."""
        return self.focal / max(float(point[2]), 0.05)

    def capsule(
        self, start: Points, end: Points, radii: tuple[float, float], bulge: float | None = None
    ) -> Capsule:
        """Return a limb between two points, radii in metres; see `Capsule` for the bulge."""
        (u, v), (x, y) = self(np.stack([start, end])).tolist()
        at_start, at_end = radii[0] * self.scale(start), radii[1] * self.scale(end)
        return Capsule((u, v), (x, y), at_start, at_end, bulge)

    def plane(self, origin: Points, axes: Points) -> tuple[NDArray, NDArray]:
        """Return the place [2] of the origin and pixels per metre [2, 2] along two axes, seen from afar."""
        linear = self.K[:2, :2] @ axes[:2] / max(float(origin[2]), 0.05)
        return self(origin), linear


def body_parts(pose: Pose, worn: Wardrobe, K: NDArray) -> list[Part]:
    """Return every part of one person, always in the same order.

    Args:
        pose: camera axes, metres. worn: clothes and skin. K: camera matrix [3, 3].
    """
    view = Projection(K)
    parts = [*_legs(pose, worn, view), _torso(pose, worn, view), _neck(pose, worn, view)]
    parts += [_head(pose, worn, view), *_arm(0, pose, worn, view), *_arm(1, pose, worn, view)]
    return parts


# --- trunk and head -------------------------------------------------------------------------------

_HIPS = np.array([0.0, 0.41, 0.0])  # the joint that the torso turns about


def _legs(pose: Pose, worn: Wardrobe, view: Projection) -> list[Part]:
    hips = pose.on_torso(_HIPS)
    colour = np.asarray(worn.look.trousers, np.float32)
    depth = max(float(hips[2]), float(pose.neck[2])) + 0.06
    legs = []
    for x in (0.072, -0.072):
        top = hips + pose.upright @ (x, 0.12, 0.0)
        foot = hips + pose.upright @ (1.3 * x, 0.95, 0.0)
        capsule = view.capsule(top, foot, (0.088, 0.062))
        legs.append(Part("legs", depth, Limb(capsule, colour, 0.05)))
    return legs


def _torso(pose: Pose, worn: Wardrobe, view: Projection) -> Part:
    sides = []
    for sign, joint in ((1.0, 2), (-1.0, 5)):
        x, y, _ = (pose.joints[joint] - pose.neck) @ pose.torso
        x = sign * x
        outline = np.array(
            [(0.056, -0.056), (0.068, -0.030), (0.62 * x, y - 0.076), (x, y - 0.060),
             (x + 0.028, y - 0.02), (x, y + 0.06), (0.152, 0.25), (0.146, 0.37), (0.156, 0.48),
             (0.163, 0.555)]
        )  # fmt: skip
        sides.append(outline * (sign, 1))
    top, hem = [(-0.034, -0.030), (0.0, -0.018), (0.034, -0.030)], [(0.0, 0.568)]
    outline = np.concatenate([top, sides[0], hem, sides[1][::-1]])
    outline = _rounded(np.concatenate([outline, np.zeros((len(outline), 1))], 1))
    # Below the hips the clothes hang: they do not swing out when the torso leans.
    hips, below = pose.on_torso(_HIPS), outline[:, 1:2] > _HIPS[1]
    hanging = hips + (outline - _HIPS) @ pose.upright.T
    points = view(np.where(below, hanging, pose.on_torso(outline)))
    left, up, scale = TORSO_TEXTURE
    place, axes = view.plane(pose.neck, pose.torso[:, :2])
    shift = place + axes @ (left + 0.5 / scale, up + 0.5 / scale)
    to_image = np.concatenate([axes / scale, shift[:, None]], 1)
    return Part("torso", float(pose.neck[2]) + 0.03, Outline(points, worn.torso, to_image))


def _rounded(outline: Points) -> Points:
    """Return a closed outline with its corners cut twice (Chaikin)."""
    for _ in range(2):
        following = np.roll(outline, -1, 0)
        both = (0.75 * outline + 0.25 * following, 0.25 * outline + 0.75 * following)
        outline = np.stack(both, 1).reshape(-1, outline.shape[1])
    return outline


def _neck(pose: Pose, worn: Wardrobe, view: Projection) -> Part:
    import cv2

    face = _face(pose)
    jaw = np.stack([face + pose.head @ (x, 0.02, 0.03) for x in (-0.044, 0.044)])
    base = pose.on_torso(np.array([(-0.055, 0.0, 0.0), (0.055, 0.0, 0.0)]))
    wide = pose.on_torso(np.array([(-0.046, -0.06, 0.0), (0.046, -0.06, 0.0)]))
    points = view(np.stack([jaw[0], jaw[1], wide[1], base[1], base[0], wide[0]]))
    corners = np.array([points[0], points[1], (points[3] + points[4]) / 2], np.float32)
    height, width = worn.neck.shape[:2]
    ends = [(0, 0), (width - 1, 0), ((width - 1) / 2, height - 1)]
    to_image = cv2.getAffineTransform(np.array(ends, np.float32), corners)
    # Before the torso, whose collar hides its lower end.
    return Part("neck", float(pose.neck[2]) + 0.031, Outline(points, worn.neck, to_image))


def _face(pose: Pose) -> Points:
    return pose.joints[3] + pose.head @ np.array(FACE_FROM_HEAD)


def _head(pose: Pose, worn: Wardrobe, view: Projection) -> Part:
    place, axes = view.plane(_face(pose), pose.head[:, :2])
    depth = float(min(pose.joints[3, 2], pose.neck[2] + 0.02))
    return Part("head", depth, Picture(worn.portrait.head, place, axes))


# --- arms -----------------------------------------------------------------------------------------

_SLEEVE, _BARE = (0.041, 0.034), (0.037, 0.026)  # radii at elbow and wrist
_UPPER, _THIN = (0.053, 0.043), (0.048, 0.038)  # at shoulder and elbow


def _arm(side: int, pose: Pose, worn: Wardrobe, view: Projection) -> list[Part]:
    shoulder, elbow, wrist, hand = pose.arm(side)
    name = ("left", "right")[side]
    cloth = np.asarray(worn.look.clothes, np.float32)
    if worn.look.sleeves == "long":
        upper = Limb(view.capsule(shoulder, elbow, _UPPER), cloth, 0.07, 0.4)
        cuff = elbow + 1.02 * (wrist - elbow)
        fore = Limb(view.capsule(elbow, cuff, _SLEEVE, 0.12), cloth, 0.08)
    else:
        upper = Limb(view.capsule(shoulder, elbow, _THIN), worn.skin)
        fore = Limb(view.capsule(elbow, wrist, _BARE), worn.skin)
    # A hanging arm lies in the torso's plane and is seen before it.
    depth = float(shoulder[2] + elbow[2]) / 2 - 0.04
    parts = [Part(f"upper_arm_{name}", depth, upper)]
    if worn.look.sleeves == "short":
        end = shoulder + 0.62 * (elbow - shoulder)
        sleeve = Limb(view.capsule(shoulder, end, (0.056, 0.058), 0.15), cloth, 0.04, 0.6)
        parts.append(Part(f"upper_arm_{name}", depth - 0.001, sleeve))
    parts.append(Part(f"forearm_{name}", float(elbow[2] + wrist[2]) / 2 - 0.045, fore))
    # As near as the forearm, the hand comes out of its sleeve; nearer, it is seen before it.
    parts.append(Part(f"hand_{name}", float(hand[2]) - 0.02, _hand(pose, side, worn, view)))
    return parts


def _hand(pose: Pose, side: int, worn: Wardrobe, view: Projection) -> Picture:
    shoulder, elbow, wrist, hand = pose.arm(side)
    fingers = (hand - wrist) / max(float(np.linalg.norm(hand - wrist)), 1e-6)
    # Between palm up and palm down the thumb lies in the plane of the arm, on the shoulder's side;
    # where the arm is straight it points forward.
    towards = (shoulder - elbow) / max(float(np.linalg.norm(shoulder - elbow)), 1e-6)
    towards = towards - 0.25 * pose.torso[:, 2]
    thumb = towards - fingers * (towards @ fingers)
    thumb = thumb / max(float(np.linalg.norm(thumb)), 1e-6)
    place, axes = view.plane(hand, np.stack([fingers, thumb], 1))
    scale = view.scale(hand)
    # Seen from the edge or the finger tips a hand still has a thickness.
    along = axes[:, 0]
    length = max(float(np.linalg.norm(along)), 1e-6)
    across = np.array([-along[1], along[0]]) / length
    breadth = float(across @ axes[:, 1])
    breadth = np.copysign(max(abs(breadth), 0.55 * scale), breadth)
    skew = float(along @ axes[:, 1]) / length
    along = along / length * max(length, 0.55 * scale)
    sideways = across * breadth + 0.5 * skew * along / np.linalg.norm(along)
    return Picture(worn.hand, place, np.stack([along, sideways], 1))
