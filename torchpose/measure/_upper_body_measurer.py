"""Measure head, neck and hands of all persons in a video, frame by frame."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose._core.checks import check_choice, check_count, check_rate, check_rgb
from torchpose._core.images import Image
from torchpose._core.module_state import CpuModule, as_one_run
from torchpose.errors import InputError
from torchpose.measure._background import BackgroundModel
from torchpose.measure._face import FaceTracker, FaceTracks
from torchpose.measure._face_detector import FaceDetector, scaled_back
from torchpose.measure._grey_frame import GreyFrame, grey_scale
from torchpose.measure._hand_likelihood import HandMeasurements
from torchpose.measure._hand_network import shipped_hand_network
from torchpose.measure._hand_windows import HandView, HandWindowState
from torchpose.measure._hands import HandBeliefs, HandTracker
from torchpose.measure._head import FACE_OFFSETS, WITHOUT_ELBOWS, HeadNeck
from torchpose.measure._mean_shift_hands import MeanShiftHandState, MeanShiftHandTracker
from torchpose.measure._persons import (
    PersonRegister,
    Persons,
    largest_persons,
    measure_by_scale,
    take_rows,
)
from torchpose.measure._scene_cuts import SceneCuts, SceneState
from torchpose.measure._skin import SkinState, rgb_to_lab
from torchpose.measure._torso_elbows import Elbows, clothes_likelihood, elbows_from_torso
from torchpose.priors._upper_body_prior import UpperBodyPrior

MEASURED = ("head", "neck", "hand_left", "hand_right")
"""Names and order of the joints that are always measured; elbows follow if they are measured."""
_ELBOWS = ("elbow_left", "elbow_right")
_HANDS = [MEASURED.index("hand_left"), MEASURED.index("hand_right")]
HAND_TRACKERS = ("learnt", "grid", "mean-shift")
"""Names of the hand trackers, the default first."""

_UNSEEN = 1.0  # seconds over which a face that is not detected counts as measured
_LEVEL = math.sqrt(2.0)
_MOVES = 0.15  # deviation of a hand's motion in a frame, in sizes of the face
_TORSO_FACE = 24.0  # size of a face in the image in which elbows are measured, pixels


class FrameMeasurements(NamedTuple):
    """Holds the measurements of N persons in a frame; pixels.

    Attributes:
        person: their numbers, in the order of appearance [N].
        keypoints: of the measurer's `names` [N, J, 2], NaN where missing. covariance: [N, J, 2, 2].
        faces: (x, y, size) [N, 3]. hands: of the hand tracker.
        cut: whether the video cuts to another scene before this frame.
    """

    person: Int[Tensor, " N"]
    keypoints: Float[Tensor, "N J 2"]
    covariance: Float[Tensor, "N J 2 2"]
    faces: Float[Tensor, "N 3"]
    hands: HandMeasurements
    cut: bool = False

    @property
    def absent(self) -> Float[Tensor, "N J"]:
        """Return the probability that a joint cannot be seen [N, J]; NaN where nothing is known."""
        absent = torch.full_like(self.keypoints[..., 0], torch.nan)
        absent[:, _HANDS] = self.hands.absent.to(absent)
        return absent


class Candidates(NamedTuple):
    """Holds the hands, left and right, by a pose filter: mean [..., 2, 2] and covariance, pixels."""

    mean: Tensor
    covariance: Tensor


class SeenPersons(NamedTuple):
    """Holds what the images so far tell of persons, apart from beliefs about their hands.

    Attributes:
        faces, persons: tracked and numbered. windows: about the faces; None for mean shift.
        frame: number of frames before. followed: numbers of those who were measured last [n].
        scene: of `SceneCuts`.
    """

    faces: FaceTracks
    persons: Persons
    windows: HandWindowState | None
    frame: int
    followed: Int[Tensor, " n"]
    scene: SceneState


class PersonsView(NamedTuple):
    """Holds what the image of a frame shows of N persons.

    Attributes:
        after: the state for the next frame; None where another process keeps it.
        faces: (x, y, size) [N, 3]. covariance: [N, 3, 3].
        number: of each person. foreground: of the background model, if any.
        hands: what windows show; None for mean shift, and without persons.
        cut: whether the video cuts to another scene before this frame.
    """

    after: SeenPersons | None
    faces: Float[Tensor, "N 3"]
    covariance: Float[Tensor, "N 3 3"]
    number: Int[Tensor, " N"]
    foreground: Image | None
    hands: HandView | None
    cut: bool


class MeasurerState(NamedTuple):
    """Holds what was seen of the persons, and the state of their hand trackers."""

    seen: SeenPersons
    hands: HandBeliefs | MeanShiftHandState


class UpperBodyMeasurer(CpuModule):
    """Measures head, neck and hands of all persons in a video, frame by frame.

    Faces are detected and tracked. They give head and neck, the colours of skin, and the region of the
    hands. Where the video cuts to another scene, all begins anew, and only the clothes by which persons
    are recognised are kept.

    Args:
        prior: of poses; gives the density of hands relative to the face.
        fps: frames per second.
        hands: "learnt" (`HandTracker` with the network that comes along), "grid" (without it) or
            "mean-shift" (`MeanShiftHandTracker`, the paper's recipe).
        background: whether to detect the foreground, for a static camera, and of one stream at a time.
        elbows: whether to measure elbows: by the network, or without one where the torso with its sleeves
            is widest. By default they are measured if hands are "learnt".
        face_detector: by default Haar's.
        max_persons: at most so many persons at a time are measured, those with the largest faces; who is
            measured gives way to a face that is a fifth larger.
        head_neck: offsets of head and neck from the face; by default the neck is higher if a network
            measures elbows.

    Raises:
        InputError: settings out of range.

    Reference:
        Burke & Lasenby, section 5. Several persons are an addition.
    """

    def __init__(
        self,
        prior: UpperBodyPrior,
        fps: float = 30.0,
        hands: str = "learnt",
        background: bool = False,
        elbows: bool | None = None,
        face_detector: FaceDetector | None = None,
        max_persons: int | None = None,
        head_neck: HeadNeck | None = None,
    ) -> None:
        super().__init__()
        check_choice("hands", hands, HAND_TRACKERS)
        if max_persons is not None:
            check_count("max_persons", max_persons)
        self.fps, self.max_persons = check_rate("fps", fps), max_persons
        self.learnt = hands == "learnt"
        measured = self.learnt if elbows is None else elbows
        self.names = MEASURED + _ELBOWS if measured else MEASURED
        # faster videos are searched as often as those of 30, for heads that move fast
        self.face_tracker = FaceTracker(face_detector, rate=max(1.0, 30.0 / self.fps))
        offsets = FACE_OFFSETS if self.learnt and measured else WITHOUT_ELBOWS
        if not isinstance(head_neck, HeadNeck | None):
            raise InputError(
                f"head_neck must be a HeadNeck, got {type(head_neck).__name__}; its offsets are those of "
                "head and neck below the face"
            )
        self.head_neck = HeadNeck(offsets) if head_neck is None else head_neck
        self.register = PersonRegister(within=round(30 * self.fps))
        self.scene_cuts = SceneCuts(self.fps)
        self.hand_tracker: HandTracker | MeanShiftHandTracker
        if hands != "mean-shift":
            network = shipped_hand_network() if self.learnt else None
            self.hand_tracker = HandTracker(prior, fps=self.fps, network=network, elbows=measured)
        else:
            self.hand_tracker = MeanShiftHandTracker()
        self.background = BackgroundModel() if background else None

    def init(self) -> MeasurerState:
        """Return the state before the first frame, and reset the background model."""
        self._forget_background()
        persons, scene = self.register.init(), self.scene_cuts.init()
        seen = SeenPersons(self.face_tracker.init(), persons, None, 0, persons.last_seen, scene)
        if isinstance(self.hand_tracker, HandTracker):
            windows, beliefs = self.hand_tracker.init()
            return MeasurerState(seen._replace(windows=windows), beliefs)
        return MeasurerState(seen, self.hand_tracker.init())

    def _forget_background(self) -> None:
        if self.background is not None:
            self.background.reset()

    @as_one_run
    def look(self, seen: SeenPersons, image: Image) -> PersonsView:
        """Return what the next frame shows of the persons, apart from beliefs about their hands.

        It depends on the images alone, so this part of `step` may run ahead in another thread.

        Args:
            seen: of the state from `init`, or `after` the frame before. image: RGB, uint8 [H, W, 3].

        Returns:
            `PersonsView`, whose `after` is what to look with at the next frame.

        Raises:
            InputError: another kind of image.
        """
        check_rgb("a frame", image, empty=False)
        scene, cut = self.scene_cuts.step(seen.scene, image)
        if cut:  # without faces, hands are forgotten as well
            self._forget_background()
        if cut or seen.scene.blank:  # the first frame that shows something is searched at once
            seen = seen._replace(faces=self.face_tracker.begin_anew(seen.faces))
        tracks = self._follow_faces(seen.faces, image)
        faces, face_cov, identity, detected = self._used(tracks, seen.persons, image)
        persons, number = self.register.step(
            seen.persons, image, faces, identity, seen.frame, detected, ~detected
        )
        own = persons.face_of(number) == identity  # else who had the face is found elsewhere
        faces, face_cov, number = faces[own], face_cov[own], number[own]
        if self.max_persons is not None:
            rows = largest_persons(number, faces[:, 2], seen.followed, self.max_persons)
            faces, face_cov, number = faces[rows], face_cov[rows], number[rows]
        foreground = None
        if self.background is not None:
            foreground = self.background.step_in_order(seen.frame, image, faces)
        windows, hands = seen.windows, None
        if isinstance(self.hand_tracker, HandTracker) and windows is not None:
            windows, hands = self.hand_tracker.look(windows, image, faces, number, foreground)
        after = SeenPersons(tracks, persons, windows, seen.frame + 1, number, scene)
        return PersonsView(after, faces, face_cov, number, foreground, hands, cut)

    def _follow_faces(self, tracks: FaceTracks, image: Image) -> FaceTracks:
        """Return the faces of the next frame, in pixels of a smaller image where the frame is large."""
        return self.face_tracker.step(tracks, GreyFrame(image))

    @as_one_run
    def step(
        self,
        state: MeasurerState,
        image: Image,
        view: PersonsView | None = None,
        candidates: Mapping[int, Candidates] | None = None,
    ) -> tuple[MeasurerState, FrameMeasurements]:
        """Return the next state and the measurements of the next frame.

        Args:
            state: from `init` or the step before. image: RGB, uint8 [H, W, 3].
            view: of this frame by `look`, if that has been called already.
            candidates: hands of these persons by a pose filter; not for "mean-shift".

        Returns:
            The next state, and `FrameMeasurements` of all persons, pixels.

        Raises:
            InputError: what is no state of it, another kind of image, or candidates for a tracker that takes
            none.
        """
        if not isinstance(state, MeasurerState):
            raise InputError(
                f"state must be a MeasurerState, got {type(state).__name__}; begin with init, and pass on "
                "what the step before returned"
            )
        if view is None:
            view = self.look(state.seen, image)
        faces, number = view.faces, view.number
        hand_state, hands = self._hands(state.hands, image, view, candidates)
        parts = [self.head_neck(faces, view.covariance), (_where_seen(hands), hands.covariance)]
        if len(self.names) > len(MEASURED):
            if self.learnt:
                found = Elbows(hands.elbows, hands.elbow_covariance, hands.elbow_seen)
            else:
                gain = torch.ones(len(faces)) if view.hands is None else view.hands.gain
                found = self._elbows(image, faces, hand_state.skin, gain)
            parts.append((_where_seen(found), found.covariance))
        keypoints = torch.cat([points.to(faces) for points, _ in parts], 1)
        cov = torch.cat([own.to(faces) for _, own in parts], 1)
        eye = torch.eye(2, dtype=cov.dtype)
        cov = torch.where(keypoints.isfinite().all(-1)[..., None, None], cov, eye)
        cov = rounded_covariance(cov)
        measured = FrameMeasurements(number, keypoints, cov, faces, hands, view.cut)
        return MeasurerState(view.after or state.seen, hand_state), measured

    def _hands(
        self,
        state: HandBeliefs | MeanShiftHandState,
        image: Image,
        view: PersonsView,
        candidates: Mapping[int, Candidates] | None,
    ) -> tuple[HandBeliefs | MeanShiftHandState, HandMeasurements]:
        """Return the next state of the hand tracker, and the hands in a frame."""
        tracker = self.hand_tracker
        if isinstance(tracker, HandTracker) and isinstance(state, HandBeliefs):
            expected = None
            if candidates is not None:
                expected = _expected(candidates, view.number, view.faces[:, 2])
            return tracker.find(state, view.hands, expected)
        if isinstance(tracker, HandTracker) or isinstance(state, HandBeliefs):
            raise InputError(
                f"expected a state of {type(tracker).__name__}, got {type(state).__name__}; "
                "begin with init"
            )
        if candidates is not None:
            raise InputError("candidates need hands='learnt' or 'grid': mean shift takes none")
        return tracker.step(state, image, view.faces, view.number, view.foreground)

    def _elbows(self, image: Image, faces: Tensor, skin: SkinState, gain: Tensor) -> Elbows:
        """Return the elbows from the clothes, in images scaled such that faces have one size.

        The colours of skin are those of images that were multiplied by the gain of each person.

        The scale of a person's image depends on that person's face alone.
        """

        def measure(scale: float, rows: Tensor) -> Elbows:
            return self._elbows_at(image, scale, faces[rows], take_rows(skin, rows), gain[rows])

        return measure_by_scale((_TORSO_FACE / faces[:, 2]).clamp_max(1.0), measure)

    def _elbows_at(
        self, image: Image, scale: float, faces: Tensor, skin: SkinState, gain: Tensor
    ) -> Elbows:
        """Return the elbows of persons in an image that is made smaller by this factor."""
        import cv2

        shape = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
        small = cv2.resize(image, shape, interpolation=cv2.INTER_AREA)
        pixels = torch.from_numpy(np.asarray(small)).permute(2, 0, 1)[None].float() / 255
        model = self.hand_tracker.skin
        lit = (pixels * gain.to(pixels)[:, None, None, None]).clamp_max(1)
        bins = model.bins(rgb_to_lab(lit))
        shrunk = torch.cat([(faces[:, :2] + 0.5) * scale - 0.5, faces[:, 2:] * scale], 1)
        found = elbows_from_torso(clothes_likelihood(model, skin, bins), shrunk)
        return Elbows((found.points + 0.5) / scale - 0.5, found.covariance / scale**2, found.seen)

    def _used(
        self, tracks: FaceTracks, persons: Persons, image: Image
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the faces in use, pixels of the frame, covariances, identities, whether detected lately.

        A face that is not detected any more is taken to be turned away or covered, unless the border of the
        image cuts it or the clothes below are not there any more: then the person has left, or is hidden.
        """
        scale, at, half = grey_scale(image), tracks.mean[:, :2], tracks.mean[:, 2:3] / 2
        end = scale * at.new_tensor([image.shape[1], image.shape[0]])
        detected = tracks.unseen <= 2 * self.face_tracker.every
        used = self.face_tracker.usable(tracks) & (tracks.unseen <= _UNSEEN * self.fps)
        used &= ((at >= 0) & (at < end)).all(-1)
        used &= detected | ((at >= half) & (at < end - half)).all(-1)
        lost = torch.nonzero(used & ~detected).flatten()
        if len(lost):
            where = scaled_back(tracks.mean[lost, :3], scale)
            used[lost] = self.register.recognises(persons, image, where, tracks.identity[lost])
        rows = torch.nonzero(used).flatten()
        faces = scaled_back(tracks.mean[rows, :3], scale)
        cov = tracks.cov[rows, :3, :3] / scale**2
        return faces, cov, tracks.identity[rows], detected[rows]


def _expected(
    candidates: Mapping[int, Candidates], number: Int[Tensor, " N"], size: Float[Tensor, " N"]
) -> Candidates:
    """Return the candidates of the persons of a frame, NaN without any, widened by a hand's motion."""
    nothing = Candidates(torch.full((2, 2), torch.nan), torch.full((2, 2, 2), torch.nan))
    found = [candidates.get(n, nothing) for n in number.tolist()]
    mean = torch.stack([each.mean.to(size) for each in found]) if found else size.new_zeros(0, 2, 2)
    cov = [each.covariance.to(size) for each in found]
    moved = (_MOVES * size).square()[:, None, None, None] * torch.eye(2).to(size)
    return Candidates(mean, torch.stack(cov) + moved if cov else size.new_zeros(0, 2, 2, 2))


def _where_seen(found: HandMeasurements | Elbows) -> Float[Tensor, "N 2 2"]:
    return torch.where(found.seen[..., None], found.points, torch.nan)


def rounded_covariance(cov: Float[Tensor, "*batch 2 2"]) -> Float[Tensor, "*batch 2 2"]:
    """Return isotropic covariances, their deviations rounded to powers of sqrt(2).

    Filters share their gains between frames of equal covariances.
    """
    variance = cov.diagonal(dim1=-2, dim2=-1).mean(-1)
    std = _LEVEL ** (0.5 * variance.log() / math.log(_LEVEL)).round()
    return std.square()[..., None, None] * torch.eye(2, dtype=cov.dtype, device=cov.device)
