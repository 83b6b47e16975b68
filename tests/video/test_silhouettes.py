import cv2
import numpy as np
import pytest
import torch

from torchpose.camera import PinholeCamera
from torchpose.errors import CameraError, InputError
from torchpose.video import SilhouetteMeasurer, VideoFrame, VideoSource, read_silhouettes
from torchpose.video._silhouettes import clean_silhouette, fit_view, fit_views


class Frames(VideoSource):
    """Frames from memory."""

    def __init__(self, frames, fps=30.0):
        super().__init__("memory")
        self.frames, self.fps, self.n_frames = frames, fps, len(frames)
        self.size = frames[0].shape[1::-1]

    def _read(self):
        for i, frame in enumerate(self.frames):
            yield VideoFrame(frame, i / self.fps, i)

    def _release(self):
        pass


def scene(height=240, width=320, seed=0):
    rng = np.random.default_rng(seed)
    small = rng.integers(90, 200, (height // 20, width // 20, 3)).astype(np.uint8)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)


def with_person(image, x=160, colour=(210, 30, 160)):
    """The scene with a person, and the truth."""
    drawn, truth = image.copy(), np.zeros(image.shape[:2], np.uint8)
    for target, value in ((drawn, colour), (truth, 1)):
        cv2.ellipse(target, (x, 130), (22, 60), 0, 0, 360, value, -1)
        cv2.circle(target, (x, 55), 16, value, -1)
    return drawn, truth > 0


def overlap(a, b):
    return (a & b).sum() / (a | b).sum()


def test_scaled_camera_sees_points_where_the_scaled_image_has_them():
    camera = PinholeCamera(
        800, 780, 310, 250, 640, 480, "a", rotation=[0.1, -0.2, 0.05], translation=[0.1, 0, 3]
    )
    view = fit_view(camera, (640, 480), 120, 160)
    points = torch.tensor([[0.2, 0.1, 0.3], [-0.4, 0.3, 0.0]], dtype=torch.float64)
    full, small = camera(points)[:, :2], view.camera(points)[:, :2]
    torch.testing.assert_close((small + 0.5) * 4, full + 0.5)


def test_image_of_another_aspect_is_not_stretched():
    view = fit_view(PinholeCamera(500, 500, 99.5, 199.5, 200, 400), (200, 400), 120, 160)
    assert view.inner == (60, 120)
    assert view.camera.image_size == (160, 120)
    assert float(view.camera.matrix[0, 0]) == pytest.approx(float(view.camera.matrix[1, 1]))


@pytest.mark.parametrize("from_empty", [True, False])
def test_a_person_is_found_and_their_shadow_is_not(from_empty):
    background = scene()
    view = fit_view(PinholeCamera(300, 300, 159.5, 119.5, 320, 240), (320, 240), 240, 320)
    frame, truth = with_person(background)
    shadow = frame.copy()
    shadow[200:220, 180:280] = (shadow[200:220, 180:280] * 0.7).astype(np.uint8)
    if from_empty:
        rng = np.random.default_rng(1)
        noise = rng.normal(0, 2, (8, *background.shape))
        empty = (background + noise).clip(0, 255).astype(np.uint8)
        measurer = SilhouetteMeasurer(view, empty=list(empty))
    else:
        passing = [with_person(background, x)[0] for x in range(30, 300, 9)]
        measurer = SilhouetteMeasurer(view, frames=passing)
    assert overlap(measurer(shadow), truth) > 0.93
    assert not measurer(background).any()


def test_what_was_moved_since_the_scene_was_empty_is_no_person():
    empty = scene()
    moved = empty.copy()
    cv2.rectangle(moved, (20, 150), (90, 220), (20, 60, 220), -1)
    view = fit_view(PinholeCamera(300, 300, 159.5, 119.5, 320, 240), (320, 240), 240, 320)
    frames = [with_person(moved, x)[0] for x in range(60, 300, 6)]
    frame, truth = with_person(moved, 75)
    assert overlap(SilhouetteMeasurer(view, empty=[empty])(frame), truth) < 0.75
    measurer = SilhouetteMeasurer(view, empty=[empty], frames=frames)
    assert overlap(measurer(frame), truth) > 0.93


def test_distortion_is_undone():
    camera = PinholeCamera(300, 300, 159.5, 119.5, 320, 240, distortions=(-0.3, 0.1, 0.001, -0.002))
    straight, truth = with_person(scene(), 60)
    K, d = camera.matrix.numpy(), camera.distortions.numpy()
    # where each distorted pixel comes from: undistorted coordinates of its place
    grid = np.stack(np.meshgrid(np.arange(320), np.arange(240)), -1).reshape(-1, 1, 2)
    source = cv2.undistortPoints(grid.astype(np.float64), K, d, P=K).reshape(240, 320, 2)
    source = source.astype(np.float32)

    def distort(image):
        return cv2.remap(image, source[..., 0], source[..., 1], cv2.INTER_LINEAR,
                         borderMode=cv2.BORDER_REPLICATE)  # fmt: skip

    view = fit_view(camera, (320, 240), 240, 320)
    measurer = SilhouetteMeasurer(view, empty=[distort(scene())])
    found = measurer(distort(straight))
    assert overlap(found, truth) > 0.93
    assert (
        overlap(found, truth)
        > overlap(clean_silhouette(distort(truth.astype(np.uint8)) > 0), truth) + 0.05
    )


def test_padding_of_codecs_is_taken_for_what_it_is():
    camera = PinholeCamera(300, 300, 159.5, 119.5, 328, 248)
    background = scene()
    frame, truth = with_person(background)
    view = fit_view(camera, (320, 240), 248, 328)
    found = SilhouetteMeasurer(view, empty=[background])(frame)
    assert overlap(found[:240, :320], truth) > 0.93
    assert not found[240:].any()
    assert not found[:, 320:].any()
    with pytest.raises(CameraError, match="calibrated for 328 x 248"):
        fit_view(camera, (300, 240), 248, 328)


def test_cleaning_keeps_large_holes_and_parts_and_drops_specks():
    _, mask = with_person(scene())
    noisy = mask.copy()
    noisy[10, 10] = True
    noisy[100:103, 150:153] = False  # a hole of the background model
    noisy[120:140, 155:165] = False  # between arm and body
    noisy[180:186, 100:104] = True  # a piece that is too small
    noisy[100:140, 250:262] = True  # a part that was cut off
    cleaned = clean_silhouette(noisy)
    assert not cleaned[10, 10]
    assert cleaned[100:103, 150:153].all()
    assert not cleaned[125:135, 158:162].any()
    assert not cleaned[180:186, 100:104].any()
    assert cleaned[105:135, 252:260].all()
    assert not clean_silhouette(np.zeros((20, 20), bool)).any()


def test_cameras_are_read_together():
    background = scene()
    view = fit_view(PinholeCamera(300, 300, 159.5, 119.5, 320, 240), (320, 240), 120, 160)
    measurers = [SilhouetteMeasurer(view, empty=[background]) for _ in range(2)]
    late = [background, *[with_person(background, x)[0] for x in (80, 120, 160)]]
    early = [with_person(background, x)[0] for x in (80, 120, 160, 200)]
    both = list(read_silhouettes([Frames(late), Frames(early)], measurers, delays=[1, 0]))
    assert len(both) == 3
    assert all(frame.shape == (2, 120, 160) for frame in both)
    assert all(torch.equal(frame[0], frame[1]) for frame in both)


def test_bad_input_is_refused():
    background = scene()
    view = fit_view(PinholeCamera(300, 300, 159.5, 119.5, 320, 240, "left"), (320, 240), 120, 160)
    with pytest.raises(InputError, match="empty scene"):
        SilhouetteMeasurer(view)
    with pytest.raises(InputError, match=r"give rows \(--rows\) of 240 at most"):
        fit_views([view.source], [(320, 240)], 100_000)
    measurer = SilhouetteMeasurer(view, empty=[background])
    with pytest.raises(InputError, match=r"^frames of camera 'left' must have 320 x 240"):
        measurer(background[:100])
    with pytest.raises(
        InputError, match=r"^pictures of the empty scene of camera 'left' must have"
    ):
        SilhouetteMeasurer(view, empty=[background[:100]])
    with pytest.raises(InputError, match="frame rate"):
        list(read_silhouettes([Frames([background]), Frames([background], 25.0)], [measurer] * 2))
    with pytest.raises(InputError, match="as many"):
        list(read_silhouettes([Frames([background])], [measurer] * 2))
