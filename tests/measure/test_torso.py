"""Elbows of drawn silhouettes, and of recordings of signers."""

import math

import numpy as np
import pytest
import torch

import torchpose
from tests.data import data_dir_or_skip
from torchpose.errors import InputError, ShapeError
from torchpose.measure import UpperBodyMeasurer
from torchpose.measure._face import FaceTracker
from torchpose.measure._skin import SkinModel, SkinState, parts_of_persons
from torchpose.measure._torso_elbows import _supported, clothes_likelihood, elbows_from_torso

cv2 = pytest.importorskip("cv2")

SIZE = 20
FACE = torch.tensor([[80.0, 24.0, SIZE]])


def silhouette(left, right, hands=None):
    """Torso, upper arms to these elbows, forearms to hands before the belly; [1, 130, 160] of 0 and 1."""
    image = np.zeros((130, 160), np.uint8)
    cv2.rectangle(image, (62, 48), (98, 130), 255, -1)
    hands = hands or ((86, 92), (74, 92))
    for shoulder, elbow, hand in (((96, 54), left, hands[0]), ((64, 54), right, hands[1])):
        if elbow is not None:
            cv2.line(image, shoulder, elbow, 255, 9)
            cv2.line(image, elbow, hand, 255, 9)
    return torch.from_numpy(image > 0)[None].float()


@pytest.mark.parametrize(
    ("left", "right"), [((114, 90), (46, 90)), ((120, 75), (50, 88)), ((110, 95), (38, 72))]
)
def test_elbows_are_where_the_outline_is_widest_on_each_side(left, right):
    found = elbows_from_torso(silhouette(left, right), FACE)
    assert found.seen.all()
    truth = torch.tensor([[left, right]]).float()
    assert (found.points - truth).norm(dim=-1).max() < 0.5 * SIZE
    squared = (found.points - truth)[..., None, :] @ torch.linalg.inv(found.covariance)
    assert (squared @ (found.points - truth)[..., None]).max() < 4
    assert (torch.linalg.eigvalsh(found.covariance) > 0).all()


def test_each_side_by_itself():
    found = elbows_from_torso(silhouette((114, 90), None), FACE)
    assert found.seen.tolist() == [[True, False]]  # a torso alone is too narrow to be an arm
    assert torch.isnan(found.points[0, 1]).all() and torch.isfinite(found.covariance).all()


def test_a_straight_arm_is_vague_about_the_height():
    bent = elbows_from_torso(silhouette((114, 90), (46, 90)), FACE)
    hanging = elbows_from_torso(silhouette((108, 85), (46, 90), hands=((109, 125), (74, 92))), FACE)
    if bool(hanging.seen[0, 0]):
        assert hanging.covariance[0, 0, 1, 1] > 1.5 * bent.covariance[0, 0, 1, 1]


def test_holes_and_what_stands_beside_do_not_matter():
    plain = elbows_from_torso(silhouette((114, 90), (46, 90)), FACE)
    image = silhouette((114, 90), (46, 90))
    image[0, 70:80, 83:87] = 0  # a badge
    image[0, 60:130, 128:150] = 1  # a chair in the same colour
    image[0, 75, 20:60] = 1  # a stripe of noise
    found = elbows_from_torso(image, FACE)
    assert found.seen.all()
    torch.testing.assert_close(found.points, plain.points, atol=1.0, rtol=0)


def test_what_the_border_cuts_is_missing():
    image = silhouette((114, 90), (46, 90))[..., 46:]
    found = elbows_from_torso(image, FACE - torch.tensor([[46.0, 0, 0]]))
    assert found.seen.tolist() == [[True, False]]
    cut = elbows_from_torso(silhouette((114, 90), (46, 90))[:, :80], FACE)
    assert not cut.seen.any()


def test_nothing_and_everything_are_no_elbows():
    assert not elbows_from_torso(torch.zeros(1, 130, 160), FACE).seen.any()
    assert not elbows_from_torso(torch.ones(1, 130, 160), FACE).seen.any()
    nobody = elbows_from_torso(torch.zeros(0, 130, 160), FACE[:0])
    assert nobody.points.shape == (0, 2, 2)


def test_a_batch_is_its_elements_and_scale_does_not_matter():
    images = torch.cat([silhouette((114, 90), (46, 90)), silhouette((112, 92), (48, 86))])
    both = elbows_from_torso(images, FACE.repeat(2, 1))
    for n in range(2):
        alone = elbows_from_torso(images[n : n + 1], FACE)
        torch.testing.assert_close(both.points[n], alone.points[0])
    large = torch.nn.functional.interpolate(images[:, None], scale_factor=2.0)[:, 0]
    twice = elbows_from_torso(large, (2 * FACE).repeat(2, 1))
    torch.testing.assert_close(twice.points, 2 * both.points, atol=4.0, rtol=0)
    torch.testing.assert_close(twice.covariance, 4 * both.covariance, atol=40.0, rtol=0.3)


def widened(image, size):
    """The drawn person at another size of the face, on a canvas that all of them share."""
    scale = size / SIZE
    large = torch.nn.functional.interpolate(image[None], scale_factor=scale)[0]
    canvas = torch.zeros(1, 400, 500)
    canvas[:, : large.shape[1], : large.shape[2]] = large
    return canvas, scale * FACE


@pytest.mark.parametrize("sizes", [(20.0, 60.0), (60.0, 20.0), (26.7, 53.3)])
def test_elbows_do_not_depend_on_how_near_others_are(sizes):
    images, faces = zip(
        *(widened(silhouette((118, 84), (44, 88)), size) for size in sizes), strict=True
    )
    both = elbows_from_torso(torch.cat(images), torch.cat(faces))
    assert both.seen.all()
    for n in range(2):
        alone = elbows_from_torso(images[n], faces[n])
        for found, expected in zip(both, alone, strict=True):
            assert torch.equal(found[n], expected[0])


def test_the_measurer_looks_at_everybody_in_an_image_of_their_own_scale():
    measurer = UpperBodyMeasurer(torchpose.load_prior("kinect-upper-body"), elbows=True)
    image = np.full((480, 900, 3), (190, 190, 180), np.uint8)
    faces = torch.tensor([[700.0, 110.0, 64.0], [180.0, 120.0, 30.0], [420.0, 120.0, 20.0]])
    for (x, y, b), cloth in zip(
        faces.tolist(), ((40, 50, 115), (120, 40, 40), (30, 110, 50)), strict=True
    ):
        drawn = silhouette((118, 84), (44, 88))[0].numpy()
        drawn = cv2.resize(drawn, None, fx=b / SIZE, fy=b / SIZE, interpolation=cv2.INTER_NEAREST)
        top, left = round(y - 24 * b / SIZE), round(x - 80 * b / SIZE)
        rows, columns = np.nonzero(drawn[: 480 - top])
        inside = columns + left < 900
        image[rows[inside] + top, columns[inside] + left] = cloth
        cv2.circle(image, (round(x), round(y)), round(b / 2), (205, 152, 128), -1)
    model = measurer.hand_tracker.skin
    bins = model.byte_bins(
        torch.from_numpy(cv2.cvtColor(image, cv2.COLOR_RGB2Lab)).permute(2, 0, 1)[None]
    )
    skin = model.learn(
        model.init(3), bins.expand(3, -1, -1), parts_of_persons(faces, bins.shape[1:])
    )
    gain = torch.ones(3)
    together = measurer._elbows(image, faces, skin, gain)
    assert together.seen.all()
    for n in range(3):
        own = SkinState(*(x[n : n + 1] for x in skin))
        alone = measurer._elbows(image, faces[n : n + 1], own, gain[:1])
        for found, expected in zip(together, alone, strict=True):
            assert torch.equal(found[n], expected[0])
    nobody = measurer._elbows(image, faces[:0], SkinState(*(x[:0] for x in skin)), gain[:0])
    assert nobody.points.shape == (0, 2, 2)
    dark = measurer._elbows(image // 5, faces, skin, 5 * gain)
    assert dark.seen.all() and (dark.points - together.points).abs().max() < 1


def test_support_is_the_least_reach_over_rows_of_the_own_size():
    g = torch.Generator().manual_seed(0)
    far, size = torch.rand(3, 2, 50, generator=g), torch.tensor([8.0, 40.0, 133.0])
    found = _supported(far, size)
    for person, rows in enumerate((1, 3, 10)):  # 0.075 of 8 is none: at least one
        for side in range(2):
            reach = far[person, side].tolist()
            least = [min(reach[max(0, v - rows) : v + rows + 1]) for v in range(50)]
            assert found[person, side].tolist() == least


def test_the_likelihood_is_that_of_the_colours():
    model, bins = SkinModel(), torch.tensor([[[5, 700], [900, 5]]])
    state = model.init(1)
    worn, far, face = (torch.full_like(state.far, 1e-9) for _ in range(3))
    worn.view(-1)[5], far.view(-1)[700], face.view(-1)[900] = 0.1, 0.1, 0.1
    state = state._replace(clothes=worn, far=far, face=face)
    found = clothes_likelihood(model, state, bins)[0]
    assert found[0, 0] > 0.95 and found[1, 1] > 0.95 and found[0, 1] < 0.05 and found[1, 0] > 0.95
    expected = 1 / (1 + math.exp(-1.5 * (math.log((0.1 + 2e-4) / (1e-9 + 2e-4)) - 0.5)))
    assert float(found[0, 0]) == pytest.approx(expected, rel=1e-4)
    assert clothes_likelihood(model, state, bins, skin=False)[0, 1, 0] < 0.5


def test_bad_input_is_refused():
    with pytest.raises(ShapeError, match="faces"):
        elbows_from_torso(torch.zeros(1, 9, 9), torch.ones(2, 3))
    with pytest.raises(InputError, match="positive size"):
        elbows_from_torso(torch.zeros(1, 9, 9), -FACE)
    with pytest.raises(InputError, match="threshold"):
        elbows_from_torso(torch.zeros(1, 9, 9), FACE, threshold=1.0)


@pytest.mark.data
def test_sleeves_of_a_signer():
    folder = data_dir_or_skip("video_asl")
    with np.load(folder / "help_mediapipe_pose1.npz") as file:
        names, joints = list(file["names"]), file["joints2d"]
    truth = [names.index(f"{side}_elbow") for side in ("left", "right")]
    video, faces, model = cv2.VideoCapture(str(folder / "help.mkv")), FaceTracker(), SkinModel()
    tracks, state, errors, said = faces.init(), model.init(1), [], []
    for t in range(45):
        frame = video.read()[1]
        tracks = faces.step(tracks, cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY))
        if not bool(faces.usable(tracks).any()):
            continue
        small = cv2.resize(frame, (160, 120), interpolation=cv2.INTER_AREA)
        lab = torch.from_numpy(cv2.cvtColor(small, cv2.COLOR_BGR2Lab)).permute(2, 0, 1)[None]
        bins, face = model.byte_bins(lab), tracks.mean[:1, :3].float() / 4
        state = model.learn(state, bins, parts_of_persons(face, bins.shape[1:]))
        found = elbows_from_torso(clothes_likelihood(model, state, bins), face)
        away = found.points[0] - torch.from_numpy(joints[t, truth]) / 4
        said.append(found.seen.float().mean())
        errors += (away.norm(dim=1) / face[0, 2])[found.seen[0]].tolist()
    assert np.mean(said) > 0.8 and np.median(errors) < 0.4
