"""Measure the persons in the frames of a video: by faces and hands, or by a detector of keypoints.

A frame passes two stages. `look` sees what depends on the images alone, so that it may run ahead in
another thread. `step` measures the persons, and may use the hands of the last poses.
"""

from collections.abc import Generator, Iterable, Iterator, Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Int
from torch import Tensor

from torchpose._core.images import Image
from torchpose._core.inference import usable_anywhere
from torchpose.errors import InputError
from torchpose.measure._keypoint_measurer import FrameKeypoints, KeypointMeasurer, KeypointState
from torchpose.measure._upper_body_measurer import (
    Candidates,
    FrameMeasurements,
    MeasurerState,
    PersonsView,
    SeenPersons,
    UpperBodyMeasurer,
)


class MissedFrame(NamedTuple):
    """Holds the measurements in a frame that a camera gave and nobody read: those of no person."""

    person: Int[Tensor, " 0"] = torch.zeros(0, dtype=torch.long)
    faces: None = None
    cut: bool = False


Found = FrameMeasurements | FrameKeypoints | MissedFrame
"""The measurements of all persons in a frame."""


class SeenFrame(NamedTuple):
    """Holds a frame, what its image shows of persons, and the number of frames missed before it.

    Attributes:
        image: RGB. view: None with a detector of keypoints. missed: the number of frames.
    """

    image: Image
    view: PersonsView | None
    missed: int = 0


class MeasuredBlock(NamedTuple):
    """Holds the measurements in some frames, and the state of the measurer after the last.

    Attributes:
        images: the frames, if anything uses them; else none. Missed frames have the image of the next one.
        found: the measurements in each. state: after the last.
        cut: whether the video cuts to another scene before the first frame; a block holds one scene.
    """

    images: list[Image]
    found: list[Found]
    state: Any
    cut: bool


@runtime_checkable
class Measurer(Protocol):
    """Protocol of the measurers of `VideoTracker`."""

    @property
    def heavy(self) -> bool:
        """Return whether `step` takes so long that a thread of its own is worth while."""
        ...

    def init(self) -> Any:
        """Return the state before the first frame."""
        ...

    def look(self, seen: SeenPersons | None, image: Image) -> SeenFrame:
        """Return the next frame with what it shows, given what was seen before."""
        ...

    def seen(self, state: Any) -> SeenPersons | None:
        """Return what was seen before; None where nothing is looked for ahead."""
        ...

    def step(
        self, state: Any, frame: SeenFrame, candidates: Mapping[int, Candidates] | None = None
    ) -> tuple[Any, Found]:
        """Return the next state and the measurements of the next frame.

        Args:
            state: the state from `init` or after the frame before. frame: from `look`.
            candidates: the hands of the last poses, by person.

        Raises:
            InputError: a state of another measurer.
        """
        ...


def measurer_of(own: UpperBodyMeasurer | KeypointMeasurer) -> Measurer:
    """Return a measurer of `torchpose.measure` with the interface of the video tracker."""
    return FaceStage(own) if isinstance(own, UpperBodyMeasurer) else DetectorStage(own)


class FaceStage(NamedTuple):
    """Measures by faces and hands; `UpperBodyMeasurer` as a `Measurer`.

    Both stages run in inference mode, in which small operations take a sixth less time than without
    gradients alone. Only the states keep tensors of it, which gradients cannot pass.
    """

    own: UpperBodyMeasurer

    @property
    def heavy(self) -> bool:
        """Return False: most of the work is in `look`, and many threads wait for each other."""
        return False

    def init(self) -> MeasurerState:
        """Return the state before the first frame."""
        return self.own.init()

    def seen(self, state: MeasurerState) -> SeenPersons:
        """Return what was seen before."""
        _check_state(state, MeasurerState)
        return state.seen

    @torch.inference_mode()
    def look(self, seen: SeenPersons | None, image: Image) -> SeenFrame:
        """Return the next frame with what it shows."""
        if seen is None:
            raise InputError("expected what was seen in the frames before, got None")
        return SeenFrame(image, self.own.look(seen, image))

    def step(
        self,
        state: MeasurerState,
        frame: SeenFrame,
        candidates: Mapping[int, Candidates] | None = None,
    ) -> tuple[MeasurerState, FrameMeasurements]:
        """Return the next state and the measurements of the next frame."""
        _check_state(state, MeasurerState)
        with torch.inference_mode():
            state, found = self.own.step(state, frame.image, frame.view, candidates)
        return state, usable_anywhere(found)


class DetectorStage(NamedTuple):
    """Measures by a detector of keypoints; `KeypointMeasurer` as a `Measurer`."""

    own: KeypointMeasurer

    @property
    def heavy(self) -> bool:
        """Return True: detectors take most of the time."""
        return True

    def init(self) -> KeypointState:
        """Return the state before the first frame."""
        return self.own.init()

    def seen(self, state: KeypointState) -> None:
        """Return None: keypoints are found in `step`."""
        _check_state(state, KeypointState)

    def look(self, seen: SeenPersons | None, image: Image) -> SeenFrame:
        """Return the next frame alone."""
        return SeenFrame(image, None)

    @torch.no_grad()
    def step(
        self,
        state: KeypointState,
        frame: SeenFrame,
        candidates: Mapping[int, Candidates] | None = None,
    ) -> tuple[KeypointState, FrameKeypoints]:
        """Return the next state and the measurements of the next frame."""
        _check_state(state, KeypointState)
        return self.own.step(state, frame.image)


def _check_state(state: Any, kind: type) -> None:
    if not isinstance(state, kind):
        raise InputError(
            "expected a state of this tracker's init or step, got one of another tracker"
        )


def look_ahead(
    measurer: Measurer, state: Any, images: Iterable[tuple[Image, int]]
) -> Iterator[SeenFrame]:
    """Yield frames with what they show, which later frames and poses do not change.

    Args:
        measurer: sees them. state: its state before the frames.
        images: each with the number of frames missed before it.
    """
    seen = measurer.seen(state)
    for image, missed in images:
        frame = measurer.look(seen, image)
        seen = None if frame.view is None else frame.view.after
        yield frame._replace(missed=missed)


def measure_blocks(
    measurer: Measurer, state: Any, frames: Iterable[SeenFrame], size: int, keep: bool
) -> Generator[MeasuredBlock, None, None]:
    """Yield blocks of measured frames, which the poses before do not change.

    Args:
        measurer: measures the persons. state: its state before the frames. frames: from `look_ahead`.
        size: the least number of frames of a block; the last one of a scene may be shorter.
        keep: whether blocks hold their images.
    """
    joined: MeasuredBlock | None = None
    for frame in frames:
        state, one = measurer.step(state, frame)
        block = block_of(frame, one, state)
        if not keep:
            block = block._replace(images=[])
        if joined is not None and block.cut:
            yield joined
            joined = None
        joined = block if joined is None else _join(joined, block)
        if len(joined.found) >= size:
            yield joined
            joined = None
    if joined is not None:
        yield joined


def _join(first: MeasuredBlock, second: MeasuredBlock) -> MeasuredBlock:
    """Return two blocks of one scene as one."""
    images, found = first.images + second.images, first.found + second.found
    return MeasuredBlock(images, found, second.state, first.cut)


def block_of(frame: SeenFrame, found: Found, state: Any) -> MeasuredBlock:
    """Return a frame and those missed before it, given its measurements and the state after it."""
    missed = [MissedFrame()] * frame.missed
    return MeasuredBlock([frame.image] * (1 + frame.missed), [*missed, found], state, found.cut)
