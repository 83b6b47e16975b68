"""Read the keypoints of a detector as pixels of the body's joints and feet, with their noise and trust."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose._core.checks import (
    CONFIDENCE_ADVICE,
    INLIER,
    MOST_CONFIDENCE,
    check_pixels,
    check_positive,
    check_shape,
    refuse_half,
)
from torchpose.body._feet import foot_points
from torchpose.body._skeleton import BODY_15, body_joints
from torchpose.camera._rig import CameraRig
from torchpose.errors import CameraError, InputError, ShapeError
from torchpose.io._keypoints import is_filled, is_on_border
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame

_LEAST_CONFIDENCE = 0.1  # the variance goes with 1 / confidence down to this
_MANY = 150  # keypoints, which tell the size of images
_BEYOND = 0.1  # share of keypoints to the right of an image, and below it
_FARTHEST = (
    5.0  # longer sides of the image away from its corner, from which on a keypoint is nobody's
)
_LONGEST_SIDE = 10_000  # pixels, of an image whose size is not known
_STDS = (1e-3, 1e6)  # pixels; beyond, matrices are not positive definite in rounding


class KeypointReader:
    """Reads keypoints of the images of a rig.

    Args:
        rig: the cameras. keypoint_std: metres, how far a detector's joints are from the body's, along each
            axis. pixel_std: pixels, how far they are apart from that.

    Raises:
        InputError: a pixel_std that no image has.
    """

    def __init__(self, rig: CameraRig, keypoint_std: float, pixel_std: float) -> None:
        if not _STDS[0] <= check_positive("pixel_std", pixel_std) <= _STDS[1]:
            raise InputError(
                f"pixel_std must lie between {_STDS[0]:g} and {_STDS[1]:g} pixels, got {pixel_std}"
            )
        self.rig, self.keypoint_std, self.pixel_std = rig, keypoint_std, pixel_std
        sides = [max(size or (_LONGEST_SIDE,)) for size in rig.sizes]
        self._farthest = _FARTHEST * torch.tensor(sides, dtype=torch.float64)[:, None, None]
        known = [(math.inf, math.inf) if size is None else size[::-1] for size in rig.sizes]
        self._sides = torch.tensor(known, dtype=torch.float64)[:, None]

    def frames_and_feet(
        self,
        keypoints: Tensor,
        confidence: Tensor | None,
        names: Sequence[str] | None,
        covariance: Tensor | None,
        fitting: bool = False,
    ) -> tuple[KeypointFrame, KeypointFrame | None]:
        """Return keypoints of `BODY_15`'s joints, and of `FEET` if the names have some of them.

        They are undistorted, with their noise and trust.

        Args:
            keypoints, confidence, names, covariance: as `BodyTracker.forward`.
            fitting: whether keypoints before these have shown that they are of the cameras' images; then a
                frame of outliers is no error.
        """
        refuse_half("keypoints", keypoints)
        names = _names_of(keypoints, names)
        shape = keypoints.shape[:-1]
        for name, value in (("confidence", confidence), ("covariance", covariance)):
            if value is not None:
                check_shape(name, value, list(shape))
        points = keypoints.to(self.rig.matrix)
        trust = self._trust(points, confidence)
        there = trust > 0
        own, relative = self._noise(trust, covariance)
        inlier = torch.where(there, trust.clamp(*INLIER), 0.0)
        table = torch.cat([points, torch.stack([own, relative, inlier], -1)], -1)
        table = table.masked_fill(~there[..., None], torch.nan)
        body, feet = body_joints(table, names), foot_points(table, names)
        if not fitting:
            self._check_inside(_pixels_of(body))
        if len(self.rig) == 1:  # of several, how they agree tells it
            self._check_size(body)
        if feet is None:
            return self._undistorted(body), None
        n_joints = body.shape[-2]
        both = self._undistorted(torch.cat([body, feet], -2))
        axis = len(shape) - 1
        n_points = both.inlier.shape[-1]
        return (
            both.map(lambda value: value.narrow(axis, 0, n_joints)),
            both.map(lambda value: value.narrow(axis, n_joints, n_points - n_joints)),
        )

    def _trust(
        self, points: Float[Tensor, "*batch C J 2"], confidence: Tensor | None
    ) -> Float[Tensor, "*batch C J"]:
        """Return how far keypoints are trusted, from 0, of those that are missing, to 1."""
        trust = torch.ones_like(points[..., 0]) if confidence is None else confidence.to(points)
        known = torch.isfinite(points).all(-1) & ~is_filled(points)
        known &= ~is_on_border(points, self._sides.to(points))
        trust = torch.where(known, trust.nan_to_num(0.0, math.inf, -math.inf), 0.0)
        outside = (trust < 0) | (trust > MOST_CONFIDENCE)
        if bool(outside.any()):
            raise InputError(
                "confidence must lie in [0, 1] (0 or NaN is missing), got "
                f"{self._first_of(trust, outside)}; {CONFIDENCE_ADVICE}"
            )
        return trust.clamp(0.0, 1.0)

    def _noise(
        self, trust: Float[Tensor, "*batch C J"], covariance: Tensor | None
    ) -> tuple[Float[Tensor, "*batch C J"], Float[Tensor, "*batch C J"]]:
        """Return variances of keypoints, pixels squared, and those that go with the body, metres squared."""
        if covariance is None:
            own = self.pixel_std**2 * torch.ones_like(trust)
            return own, self.keypoint_std**2 / trust.clamp_min(_LEAST_CONFIDENCE)
        own, (least, most) = covariance.to(trust), (std**2 for std in _STDS)
        wrong = (trust > 0) & ~((own >= least) & (own <= most))
        if bool(wrong.any()):
            raise InputError(
                f"covariance of keypoints must lie between {least:g} and {most:g} pixels squared, got "
                f"{self._first_of(own, wrong)}; a keypoint that tells nothing has the confidence 0"
            )
        return own, torch.zeros_like(trust)

    def _first_of(
        self, values: Float[Tensor, "*batch C J"], wrong: Bool[Tensor, "*batch C J"]
    ) -> str:
        """Return the first of some values that are wrong, and its camera."""
        at = tuple(wrong.nonzero()[0].tolist())
        return f"{float(values[at]):g} of camera {self.rig.names[at[-2]]!r}"

    def _undistorted(self, table: Float[Tensor, "*batch C J 5"]) -> KeypointFrame:
        """Return keypoints of a table of pixels, both parts of the noise, and trust."""
        points = _pixels_of(table)
        far = (points.abs() > self._farthest.to(points)).any(-1, keepdim=True)
        pixels = self.rig.undistort_points(points.masked_fill(far, torch.nan))
        known = pixels.isfinite().all(-1)  # some pixels are of no ray through the lens
        own, relative, inlier = table[..., 2:].nan_to_num(1.0).unbind(-1)
        return KeypointFrame(
            pixels.nan_to_num(), own, relative, torch.where(known, inlier, 0.0)
        )  # fmt: skip

    def _check_inside(self, pixels: Float[Tensor, "*batch C J 2"]) -> None:
        """Refuse shares of an image, and keypoints most of which lie far outside it: of another size."""
        side = self._sides.to(pixels)
        there = pixels.isfinite().all(-1)
        check_pixels("keypoints", pixels, there)
        outside = ((pixels < -side / 2) | (pixels > 1.5 * side)).any(-1) & there
        wrong, every = (value.movedim(-2, 0).flatten(1).sum(1) for value in (outside, there))
        most = (2 * wrong > every).tolist()
        for name, size, refused in zip(self.rig.names, self.rig.sizes, most, strict=True):
            if refused and size is not None:
                raise CameraError(
                    f"most keypoints of camera {name!r} lie outside its image of {size[1]} x "
                    f"{size[0]} pixels; if they are of a video of another size, take "
                    "rig.scaled(height, width)"
                )

    def _check_size(self, table: Float[Tensor, "*batch 1 J 5"]) -> None:
        """Refuse keypoints of many frames that lie beyond the only camera's image as those of larger ones do.

        They are to the right of it and below it, and hardly anywhere else. Hidden legs that a detector puts
        below an image are hardly to the right of it.
        """
        size, weights = self.rig.sizes[0], table[..., 4]
        if size is None or weights.numel() < _MANY:  # of few frames nothing is computed, as live
            return
        weights = weights.nan_to_num(0.0)
        if int((weights > 0).sum()) < _MANY:
            return
        height, width = size
        u, v = _pixels_of(table).unbind(-1)
        right, below, before = u > width - 0.5, v > height - 0.5, (u < -0.5) | (v < -0.5)
        shares = [
            float((weights * flags).sum() / weights.sum())
            for flags in (right | below, right, below, before)
        ]
        if shares[0] > 0.5 and min(shares[1:3]) > _BEYOND > 2 * shares[3]:
            raise CameraError(
                f"most keypoints of camera {self.rig.names[0]!r} lie to the right of its image of {width} x "
                f"{height} pixels or below it, as those of larger images do; give the calibration of the "
                "images that the keypoints are of (`size` and `matrix`, or rig.scaled(height, width)), or "
                "their size with the keypoints (image_size of .npz and .csv)"
            )


def _names_of(keypoints: Tensor, names: Sequence[str] | None) -> tuple[str, ...]:
    """Return the names of keypoints [..., J, 2], those of `BODY_15` if none are given."""
    found = BODY_15.names if names is None else tuple(names)
    if keypoints.shape[-2:] != (len(found), 2):
        of = "BODY_15, whose names count where none are given" if names is None else "names"
        raise ShapeError(
            f"keypoints must have shape [..., {len(found)}, 2], as many as {of}, got "
            f"{list(keypoints.shape)}"
        )
    return found


def _pixels_of(table: Float[Tensor, "*batch C J 5"]) -> Float[Tensor, "*batch C J 2"]:
    """Return the pixels of a table, NaN where there is no keypoint."""
    return torch.where((table[..., 4:] > 0), table[..., :2], torch.nan)
