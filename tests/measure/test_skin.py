"""The skin model against histograms by numpy, and on recordings of signers."""

import numpy as np
import pytest
import torch

from tests.data import data_dir_or_skip
from torchpose.errors import InputError, ShapeError
from torchpose.measure._skin import SkinModel, rgb_to_lab

SKIN, CLOTH, WALL = (0.80, 0.60, 0.50), (0.15, 0.20, 0.45), (0.75, 0.75, 0.70)
FACE = torch.tensor([[80.0, 40.0, 32.0]])


def person(seed=0, cloth=CLOTH):
    """A wall, a torso, a face and one hand, with noise, RGB [1, 3, 120, 160]."""
    image = torch.empty(3, 120, 160)
    image[:] = torch.tensor(WALL)[:, None, None]
    image[:, 70:, 50:110] = torch.tensor(cloth)[:, None, None]
    image[:, 22:60, 66:94] = torch.tensor(SKIN)[:, None, None]
    image[:, 80:96, 20:34] = torch.tensor(SKIN)[:, None, None]
    noise = torch.randn(image.shape, generator=torch.Generator().manual_seed(seed))
    return (image + 0.01 * noise).clamp(0, 1)[None]


def test_opencv_and_kornia_agree_and_gradients_flow():
    images = torch.rand(2, 3, 40, 30, generator=torch.Generator().manual_seed(0))
    by_opencv = rgb_to_lab(images)
    leaf = images.clone().requires_grad_(True)
    by_kornia = rgb_to_lab(leaf)
    torch.testing.assert_close(by_opencv, by_kornia.detach(), atol=0.5, rtol=0)
    assert (by_opencv - by_kornia.detach()).abs().mean() < 0.1
    by_kornia.sum().backward()
    assert torch.isfinite(leaf.grad).all() and leaf.grad.abs().max() > 0


def test_the_first_histogram_is_the_smoothed_count_of_the_face():
    lab = rgb_to_lab(person())
    model = SkinModel()
    state, _ = model.step(model.init(1), lab, FACE)
    patch = lab[0].numpy()[:, 34:52, 73:88].reshape(3, -1)  # -0.2 to 0.35 and +-0.25 of 32 pixels
    edges = (np.arange(9) * 12.5, -24 + 2.0 * np.arange(33), -24 + 3.0 * np.arange(33))
    counts, _ = np.histogramdd(patch.T, edges)
    assert counts.sum() == patch.shape[1]
    for axis, kernel in enumerate(([0.1, 0.8, 0.1], *[[0.05, 0.24, 0.42, 0.24, 0.05]] * 2)):
        counts = np.apply_along_axis(np.convolve, axis, counts, kernel, mode="same")
    np.testing.assert_allclose(state.face[0], counts / counts.sum(), atol=1e-6)


def test_a_hand_is_skin_and_clothes_and_wall_are_not():
    model, image = SkinModel(), person()
    _, skin = model.step(model.init(1), rgb_to_lab(image), FACE)
    assert skin[0, 82:94, 22:32].mean() > 0.9
    assert skin[0, 75:, 55:105].mean() < 0.05 and skin[0, :20].mean() < 0.05


def test_colours_are_averaged_over_time():
    model = SkinModel(decay=0.9)
    first, _ = model.step(model.init(1), rgb_to_lab(person()), FACE)
    other = rgb_to_lab(person(1, cloth=(0.4, 0.1, 0.1)))
    second, _ = model.step(first, other, FACE)
    alone, _ = model.step(model.init(1), other, FACE)
    torch.testing.assert_close(second.clothes, 0.9 * first.clothes + 0.1 * alone.clothes)


def test_hands_teach_neither_face_nor_clothes():
    model, image = SkinModel(), person()
    image[:, :, 75:115, 60:100] = torch.tensor(SKIN)[:, None, None]  # a large hand on the chest
    hands = torch.zeros(1, 120, 160)
    hands[:, 75:115, 60:100] = 1.0
    told, seen = model.step(model.init(1), rgb_to_lab(image), FACE, hands)
    _, blind = model.step(model.init(1), rgb_to_lab(image), FACE)
    assert seen[0, 80:110, 65:95].mean() > 0.9 > blind[0, 80:110, 65:95].mean()
    clean, _ = model.step(model.init(1), rgb_to_lab(person()), FACE)
    assert (told.clothes - clean.clothes).abs().sum() < 0.1


def test_a_face_behind_a_sleeve_keeps_what_was_known():
    model = SkinModel()
    state, _ = model.step(model.init(1), rgb_to_lab(person()), FACE)
    covered = person()
    covered[:, :, 20:62, 60:100] = torch.tensor(CLOTH)[:, None, None]
    after, _ = model.step(state, rgb_to_lab(covered), FACE)
    assert torch.equal(after.face, state.face)


def test_a_batch_is_its_elements():
    model = SkinModel()
    images, faces = torch.cat([person(0), person(1).flip(3)]), FACE.repeat(2, 1)
    faces[1, 0] = 159 - faces[1, 0]
    state, skin = model.step(model.init(2), rgb_to_lab(images), faces)
    for b in range(2):
        own, alone = model.step(model.init(1), rgb_to_lab(images[b : b + 1]), faces[b : b + 1])
        torch.testing.assert_close(skin[b], alone[0])
        torch.testing.assert_close(state.far[b], own.far[0])


def test_bad_input_is_refused():
    model, lab = SkinModel(), torch.zeros(1, 3, 20, 20)
    with pytest.raises(InputError, match="decay"):
        SkinModel(decay=1.0)
    with pytest.raises(InputError, match="batch_size"):
        model.init(0)
    with pytest.raises(InputError, match="positive size"):
        model.step(model.init(1), lab, torch.tensor([[5.0, 5.0, 0.0]]))
    with pytest.raises(ShapeError):
        model.step(model.init(2), lab, FACE)


@pytest.mark.parametrize(("clip", "least"), [("again", 0.9), ("book", 0.9)])
def test_the_face_of_a_signer_stands_out_from_the_clothes(clip, least):
    """Also from an orange jumper, which the paper's histogram alone takes for skin."""
    cv2 = pytest.importorskip("cv2")
    folder = data_dir_or_skip("video_asl")
    with np.load(folder / f"{clip}_mediapipe_pose1.npz") as landmarks:
        joints = torch.from_numpy(landmarks["joints2d"]).double()
    video, model = cv2.VideoCapture(str(folder / f"{clip}.mkv")), SkinModel()
    state = model.init(1)
    for t in range(5):
        image = cv2.cvtColor(cv2.resize(video.read()[1], (320, 240)), cv2.COLOR_BGR2RGB)
        lab = rgb_to_lab(torch.from_numpy(image).permute(2, 0, 1)[None] / 255.0)
        nose, shoulders = joints[t, 0] / 2, joints[t, [5, 6]] / 2
        size = float((shoulders[0] - shoulders[1]).norm() / 1.95)
        state, skin = model.step(state, lab, torch.tensor([[*nose.tolist(), size]]))
    x, y = (int(v) for v in nose)
    face = skin[0, y - 5 : y + 8, x - 8 : x + 8]
    chest = skin[0, y + int(1.4 * size) : y + int(2.2 * size), x - 10 : x + 10]
    better = (face.flatten()[:, None] > chest.flatten()).float().mean()
    assert better > least
