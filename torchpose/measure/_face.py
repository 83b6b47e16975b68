"""Track faces by Kalman filters (Burke & Lasenby, section 5.1).

A detector has misses and false detections. Tracks bridge the misses. A track is used only once it has
enough detections, which false ones rarely reach.
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchpose._core.checks import check_finite, check_floating, check_shape
from torchpose._core.images import Image
from torchpose.errors import InputError
from torchpose.math._gaussian import kalman_predict, kalman_update
from torchpose.measure._face_detector import (
    FaceDetector,
    HaarFaceDetector,
    Region,
    resized,
    scaled_back,
)
from torchpose.measure._face_patterns import far_smaller, on_somebody
from torchpose.measure._grey_frame import GreyFrame

# About a known face: half the side of the searched region, smallest and largest face there, in its sizes.
_CLOSE, _AROUND = (0.85, 0.8, 1.3), (1.1, 0.75, 1.4)
_LASTING = 10.0  # hits from which the closer search comes first
_AS_PREDICTED = 0.15  # largest difference in place and size at which it is enough, in those sizes
_SAME_SIZE = 1.25  # a face that differs by less from the size wanted is taken as it is
_USUAL = 40.0  # size above which faces are searched for first, pixels
_SEARCHES_FOR_LARGER = 3  # of `search_every`, while small faces alone are known
_LEAST = 4.0  # size below which a track ends: it was lost while it became smaller, pixels
_TILT = 25.0  # degrees by which an image is turned to find tilted faces


class FaceTracks(NamedTuple):
    """Holds the tracks of N faces.

    Attributes:
        mean: (x, y, size) and their velocities per frame [N, 6], pixels. cov: [N, 6, 6].
        hits: detections so far less misses, bounded [N]. age: frames since the first detection [N].
        unseen: frames since it was last detected [N]. largest: size that it has had, pixels [N].
        identity: number of each face [N]; a number is never used twice. frame: frames seen.
        next_identity: of the next face.
    """

    mean: Float[Tensor, "N 6"]
    cov: Float[Tensor, "N 6 6"]
    hits: Float[Tensor, " N"]
    age: Int[Tensor, " N"]
    unseen: Int[Tensor, " N"]
    largest: Float[Tensor, " N"]
    identity: Int[Tensor, " N"]
    frame: int
    next_identity: int


class FaceTracker(nn.Module):
    """Tracks any number of faces by constant-velocity Kalman filters over place and size.

        (p, v)_t = [I I; 0 d I] (p, v)_{t-1} + N(0, Q),   z_t = p_t + N(0, R),   p = (x, y, size)

    A detection is associated with the nearest track, by Euclidean distance over (x, y, size), if that
    is within `gate` sizes of the face; otherwise it starts a track. A track is used once it has
    `min_hits`. It loses a third of a hit for every missed detection, and ends when none is left. All
    deviations below are in sizes of the face. A track ends as well when its predicted size falls below 4
    pixels, as that of a face does which is lost while it moves away.

    Numbers of frames, `gate`, `acceleration` and `damping` are given for 30 frames per second. At another
    rate as much time passes from search to search; where frames are farther apart than that, each is
    searched, in more of the image, and faces may have moved farther.

    Args:
        detector: by default `HaarFaceDetector`; see `torchpose.measure.FaceDetector`.
        every: search for known faces in every n-th frame, in the region about them; while no track is
            used yet, in every frame.
        whole_every: search the whole image for new faces in every n-th frame. While faces of at most 40
            pixels alone are used, three times `search_every` takes its place if that is less.
        search_every: the same while no track is used.
        gate: largest distance. min_hits: detections before a track is used.
        memory: most hits of a track; it lasts for three times as many misses.
        std: of a detection's place and size. acceleration: of the process, per frame and frame.
        damping: d, of the velocity per frame.
        detail: size, in pixels, to which known faces are scaled before the search: cascades draw
            larger boxes about small faces, and large faces cost time.
        smallest: size, in pixels, of faces that are searched for where none above 40 is found; reliably
            found are those that are half as large again. 40 turns that off.
        rate: frames at 30 per second that pass in one step.

    Raises:
        InputError: settings out of range, or a detector that cannot be called.

    Reference:
        Burke & Lasenby, section 5.1.

    Example:
        >>> import numpy as np
        >>> from torchpose.measure._face import FaceTracker
        >>> tracker = FaceTracker()
        >>> tracks = tracker.step(tracker.init(), np.zeros((120, 160), np.uint8))
        >>> len(tracks.mean)
        0
    """

    def __init__(
        self,
        detector: FaceDetector | None = None,
        every: int = 2,
        whole_every: int = 45,
        search_every: int = 5,
        gate: float = 0.5,
        min_hits: int = 3,
        memory: int = 30,
        std: float = 0.04,
        acceleration: float = 0.013,
        damping: float = 0.9,
        detail: float = 80.0,
        smallest: float = 11.0,
        rate: float = 1.0,
    ) -> None:
        super().__init__()
        if min(every, whole_every, search_every, min_hits, memory) < 1 or memory < min_hits:
            raise InputError(
                "every, whole_every, search_every, min_hits and memory must be at least 1, and memory "
                f"at least min_hits, got {every}, {whole_every}, {search_every}, {min_hits}, {memory}"
            )
        if not (min(gate, std, acceleration, detail, smallest, rate) > 0 and 0 <= damping <= 1):
            raise InputError(
                "gate, std, acceleration, detail, smallest and rate must be positive and damping in [0, 1], "
                f"got {gate}, {std}, {acceleration}, {detail}, {smallest}, {rate} and {damping}"
            )
        self.detector = HaarFaceDetector() if detector is None else detector
        if not callable(self.detector):
            raise InputError(
                "a face detector must be callable, as torchpose.measure.FaceDetector, got "
                f"{type(detector).__name__}"
            )
        self.every, self.whole_every, self.search_every = (
            max(1, round(frames / rate)) for frames in (every, whole_every, search_every)
        )
        # times as far as at 30 frames per second faces move from search to search
        self.farther = max(1.0, self.every * rate / every)
        self.gate, self.min_hits, self.memory = gate, min_hits, memory
        self.std, self.rate = std, rate
        self.acceleration = acceleration * rate**1.5  # a random walk of velocities per frame
        self.detail, self.smallest = detail, smallest
        motion = torch.tensor([[1.0, 1.0], [0.0, damping**rate]], dtype=torch.float64)
        self.register_buffer("matrix", torch.kron(motion, torch.eye(3, dtype=torch.float64)))
        self.register_buffer("observed", torch.arange(3))

    matrix: Tensor
    observed: Tensor

    def init(self) -> FaceTracks:
        """Return the state without faces."""
        real, whole = self.matrix.new_zeros(0), torch.zeros(0, dtype=torch.long)
        return FaceTracks(
            real.view(0, 6), real.view(0, 6, 6), real, whole, whole.clone(), real.clone(),
            whole.clone(), 0, 0,
        )  # fmt: skip

    def begin_anew(self, tracks: FaceTracks) -> FaceTracks:
        """Return the state without faces for another scene of the same video."""
        return self.init()._replace(next_identity=tracks.next_identity)

    def usable(self, tracks: FaceTracks) -> Bool[Tensor, " N"]:
        """Return which tracks have enough detections to be used, and are no pattern beside another person."""
        enough = tracks.hits >= self.min_hits
        used = enough & ~on_somebody(tracks.mean[:, :3], enough)
        return used & ~far_smaller(tracks.mean[:, 2], tracks.largest <= _USUAL, used)

    def _is_due(self, frame: int, known: bool, interval: int) -> bool:
        """Return whether a frame is searched, by its number and whether a face is known."""
        return not known or not (frame % self.every and frame % interval)

    def _interval(self, tracks: FaceTracks, used: Bool[Tensor, " N"]) -> int:
        """Return the number of frames from one search of the whole image to the next."""
        if not bool(used.any()):
            return self.search_every
        if bool((tracks.mean[used, 2] > _USUAL).any()):
            return self.whole_every
        return min(self.whole_every, _SEARCHES_FOR_LARGER * self.search_every)

    def step(self, tracks: FaceTracks, image: Image | GreyFrame) -> FaceTracks:
        """Return the faces of the next frame.

        Args:
            tracks: from `init` or the step before.
            image: grey, [H, W], uint8, or a frame that is made grey where it is looked at.

        Raises:
            InputError: another kind of image, or a detector that returns no tensor. ShapeError: one that
                returns a tensor of another shape than [N, 3].
        """
        predicted = self._predict(tracks)
        used = self.usable(tracks)
        known, interval = bool(used.any()), self._interval(tracks, used)
        if not self._is_due(tracks.frame, known, interval):
            return predicted
        everywhere = tracks.frame % interval == 0
        faces, lasting = predicted.mean[:, :3].tolist(), (predicted.hits >= _LASTING).tolist()
        found = [self._look_near(image, *one) for one in zip(faces, lasting, strict=True)]
        if everywhere:  # last, since sizes of known faces are measured better near them
            usual = bool((predicted.mean[self.usable(predicted), 2] > _USUAL).any())
            soon = known and tracks.frame % self.whole_every != 0
            turn = _TILT if tracks.frame // self.search_every % 2 else -_TILT
            found.append(self._look_everywhere(image, usual or soon, turn))
        if not found:
            return predicted
        return self.update(predicted, _without_doubles(torch.cat(found), self.gate))

    def _detect(self, image: Image, region: Region | None = None) -> Float[Tensor, "N 3"]:
        """Return what the detector finds, which may be anybody's, once it is seen to be faces."""
        found = self.detector(image, region)
        check_floating("faces of the face detector", found)
        check_shape("faces of the face detector", found, ["N", 3])
        return found

    def _look_everywhere(
        self, image: Image | GreyFrame, plain: bool, turn: float
    ) -> Float[Tensor, "N 3"]:
        """Return the detections in the whole image: where these are none, tilted or small ones as well.

        Args:
            plain: whether tilted and small faces are left out. turn: of the image, degrees.
        """
        height, width = image.shape
        small = Region(0, 0, width, height, self.smallest, _USUAL)
        image = _seen_in(image, small)
        found = self._detect(image)
        if plain or len(found):
            return found
        found = _turned_search(self._detect, image, None, turn)
        if len(found) or self.smallest >= _USUAL:
            return found
        return self._detect(image, small)

    def _look_near(
        self, image: Image | GreyFrame, face: list[float], lasting: bool
    ) -> Float[Tensor, "N 3"]:
        """Return the detections about a known face; close to it alone if a lasting one is as predicted.

        The closer search takes half the time, and misses who moves quickly. It would find patterns again that
        are no faces, which do not last.
        """
        if lasting:
            found = self._look_about(image, face, _CLOSE, ())
            if len(found) and _as_predicted(found[0], face):
                return found
        return self._look_about(image, face, _AROUND, (-_TILT, _TILT))

    def _look_about(
        self,
        image: Image | GreyFrame,
        face: list[float],
        reach: tuple[float, float, float],
        turns: tuple[float, ...],
    ) -> Float[Tensor, "N 3"]:
        """Return the detections about a known face, the nearest first, scaled to the size `detail`.

        Args:
            reach: see `_CLOSE`. turns: degrees by which the image is turned while nothing is found.
        """
        half, smaller, larger = reach
        region = _region(face, image.shape, self.farther * half, smaller, larger)
        image = _seen_in(image, region)
        part = image[region.top : region.bottom, region.left : region.right]
        scale = self.detail / max(face[2], 1.0)
        if round(scale * min(part.shape)) < 1:  # the face is outside, or all but outside
            return torch.zeros(0, 3, dtype=torch.float64)
        if 1 / _SAME_SIZE < scale < _SAME_SIZE:
            scale, found = 1.0, self._detect(image, region)
            found = found - found.new_tensor([region.left, region.top, 0])
        else:
            part = resized(part, scale)
            found = self._detect(part, _whole(part, region, scale))
        for turn in turns:
            if not len(found):
                found = _turned_search(self._detect, part, _whole(part, region, scale), turn)
        found = scaled_back(found, scale) + found.new_tensor([region.left, region.top, 0])
        if len(found) > 1:  # of those that overlap only the first is kept: the likeliest
            found = found[(found - found.new_tensor(face)).norm(dim=1).argsort(stable=True)]
        return found

    def _predict(self, tracks: FaceTracks) -> FaceTracks:
        spread = (self.acceleration * tracks.mean[:, 2, None]).square().expand(-1, 6)
        noise = torch.diag_embed(spread)
        offset = torch.zeros_like(tracks.mean)
        mean, cov = kalman_predict(tracks.mean, tracks.cov, self.matrix, offset, noise)
        predicted = tracks._replace(
            mean=mean, cov=cov, age=tracks.age + 1, unseen=tracks.unseen + 1, frame=tracks.frame + 1
        )
        lasting = mean[:, 2] >= _LEAST
        return predicted if bool(lasting.all()) else _take(predicted, lasting)

    def update(self, tracks: FaceTracks, found: Float[Tensor, "n 3"]) -> FaceTracks:
        """Update predicted tracks with the detections (x, y, size) of their frame; start and end tracks."""
        check_shape("found", found, ["n", 3])
        check_finite("found", found)
        found = found.to(self.matrix)
        owner = _nearest(tracks.mean[:, :3], found, self.farther * self.gate)
        seen = torch.zeros(len(tracks.mean), dtype=torch.bool)
        seen[owner[owner >= 0]] = True
        z = tracks.mean[:, :3].clone()
        z[owner[owner >= 0]] = found[owner >= 0]
        noise = self._noise(tracks.mean[:, 2])
        mask = seen[:, None].expand(-1, 3)
        mean, cov, _ = kalman_update(tracks.mean, tracks.cov, z, noise, self.observed, mask)
        hits = torch.where(seen, (tracks.hits + 1).clamp_max(self.memory), tracks.hits - 1 / 3)
        unseen = torch.where(seen, 0, tracks.unseen)
        largest = tracks.largest.maximum(mean[:, 2])
        alive = hits > 0
        kept = [x[alive] for x in (mean, cov, hits, tracks.age, unseen, largest, tracks.identity)]
        new = self._new_tracks(found[owner < 0], tracks.next_identity)
        mean, cov, hits, age, unseen, largest, identity = (
            torch.cat(pair) for pair in zip(kept, new, strict=True)
        )
        following = tracks.next_identity + len(new[0])
        return FaceTracks(mean, cov, hits, age, unseen, largest, identity, tracks.frame, following)

    def _new_tracks(self, found: Tensor, first: int) -> tuple[Tensor, ...]:
        n = len(found)
        size = found[:, 2]
        spread = self.std * found.new_tensor([1.0] * 3 + [2.0 * self.rate] * 3)
        cov = torch.diag_embed((spread * size[:, None]).square())
        count = torch.zeros(n, dtype=torch.long)
        mean = torch.cat([found, torch.zeros_like(found)], 1)
        number = first + torch.arange(n)
        return mean, cov, torch.ones_like(size), count, count.clone(), size.clone(), number

    def _noise(self, size: Tensor) -> Tensor:
        return torch.diag_embed((self.std * size[:, None]).square().expand(-1, 3))


def _take(tracks: FaceTracks, rows: Bool[Tensor, " N"]) -> FaceTracks:
    """Return some of the tracks."""
    fields = (value[rows] if isinstance(value, Tensor) else value for value in tracks)
    return FaceTracks(*fields)  # type: ignore[arg-type]


def _seen_in(image: Image | GreyFrame, region: Region) -> Image:
    """Return the image, of which this region is looked at."""
    return image.at(region) if isinstance(image, GreyFrame) else image


def _whole(image: Image, sizes: Region, scale: float) -> Region:
    """Return a whole image as the region of a search, for the sizes of another region, scaled."""
    smallest, largest = scale * sizes.smallest, scale * sizes.largest
    return Region(0, 0, image.shape[1], image.shape[0], smallest, largest)


def _turned_search(
    detector: FaceDetector, image: Image, region: Region | None, degrees: float
) -> Float[Tensor, "N 3"]:
    """Return the detections in the image that is turned about its middle, and stays as large."""
    import cv2

    height, width = image.shape
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), degrees, 1.0)
    turned = cv2.warpAffine(image, matrix, (width, height), borderMode=cv2.BORDER_REPLICATE)
    found = detector(np.asarray(turned, np.uint8), region)
    back = found.new_tensor(cv2.invertAffineTransform(matrix))
    centres = found[:, :2] @ back[:, :2].T + back[:, 2]
    inside = ((centres > 0) & (centres < centres.new_tensor([width, height]))).all(1)
    return torch.cat([centres, found[:, 2:]], 1)[inside]


def _as_predicted(found: Float[Tensor, " 3"], face: list[float]) -> bool:
    """Return whether a detection differs little from the face that is expected."""
    away = (found - found.new_tensor(face)).abs()
    return float(away.max()) <= _AS_PREDICTED * face[2]


def _region(
    face: list[float], shape: tuple[int, ...], half: float, smaller: float, larger: float
) -> Region:
    """Return the part of the image about a face, empty if the face is outside, and sizes near its own."""
    size = max(face[2], 1.0)
    reach = half * size
    left, right = (min(max(0, int(face[0] + side)), shape[1]) for side in (-reach, reach))
    top, bottom = (min(max(0, int(face[1] + side)), shape[0]) for side in (-reach, reach))
    return Region(left, top, right, bottom, smaller * size, larger * size)


def _nearest(faces: Tensor, found: Tensor, gate: float) -> Int[Tensor, " n"]:
    """Return the track of each detection, -1 for none, associating the nearest pairs first."""
    distance = torch.cdist(found, faces)
    return nearest_pairs(torch.where(distance <= gate * faces[:, 2], distance, torch.inf))


def nearest_pairs(distance: Float[Tensor, "n N"]) -> Int[Tensor, " n"]:
    """Return the column of each row, -1 for none, associating the nearest pairs first.

    Args:
        distance: infinite where a row and a column cannot be a pair.

    >>> nearest_pairs(torch.tensor([[1.0, 3.0], [2.0, torch.inf], [0.5, 4.0]])).tolist()
    [1, -1, 0]
    """
    owner, distance = torch.full((len(distance),), -1), distance.clone()
    while distance.numel() and bool(torch.isfinite(distance.min())):
        row, column = divmod(int(distance.argmin()), distance.shape[1])
        owner[row] = column
        distance[row], distance[:, column] = torch.inf, torch.inf
    return owner


def _without_doubles(found: Tensor, gate: float) -> Tensor:
    """Return the detections without repetitions, which overlapping regions give."""
    if len(found) < 2:
        return found
    near = torch.cdist(found, found) <= gate * found[:, 2]
    earlier = torch.tril(near, -1).any(1)
    return found[~earlier]
