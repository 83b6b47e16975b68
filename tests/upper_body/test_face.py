"""Nose, eyes and ears: they tell a turn of the body from its mirror image."""

import math

import pytest
import torch

import torchpose
from tests.upper_body.test_articulated import CAMERA, PRIOR, ROW, body, pixels
from torchpose.math import euler_to_matrix
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body._face_points import FACE, FacePoints, face_evidence, head_in_face

TURNS = torch.deg2rad(torch.arange(-180.0, 180.0, 15.0, dtype=torch.float64))
DEPTH = torch.tensor([1.5, 2.5], dtype=torch.float64)
STD = torch.tensor([3 / 525], dtype=torch.float64)
# Metres to the left of the middle of the ears, down, and to the back, of FACE.
HEAD = torch.tensor(
    [[0.0, 0.03, -0.11], [0.032, 0.0, -0.085], [-0.032, 0.0, -0.085], [0.075, 0.0, 0.0], [-0.075, 0.0, 0.0]],
    dtype=torch.float64,
)  # fmt: skip


def face_of(turn):
    """Return the points of a face at a turn, relative to the middle of its ears, and which are visible."""
    angles = torch.tensor([0.0, 0.0, turn], dtype=torch.float64)
    rotation = euler_to_matrix(angles, "zxy")
    looks = torch.tensor([0.0, 0.3, -0.3, math.pi / 2, -math.pi / 2], dtype=torch.float64)
    return HEAD @ rotation.mT, (turn - looks).cos() > -0.2


def measured(turn, depth=2.5):
    places, visible = face_of(turn)
    uv = places[None, :, :2] / depth
    sure = visible.double()[None]
    return FacePoints(torch.where(visible[:, None], uv, 0.0), sure, torch.ones(5, dtype=torch.bool))


@pytest.mark.parametrize("degrees", [-135, -60, -15, 0, 45, 90, 180])
def test_the_evidence_is_for_where_the_head_faces(degrees):
    evidence = face_evidence(measured(math.radians(degrees)), STD, DEPTH, TURNS)[0, 1]
    found = TURNS[evidence.argmax()]
    assert math.cos(float(found) - math.radians(degrees)) > math.cos(math.radians(31))


def test_mirror_images_have_mirrored_evidence():
    left, right = (face_evidence(measured(x), STD, DEPTH, TURNS)[0] for x in (0.6, -0.6))
    torch.testing.assert_close(left[:, 1:], right[:, 1:].flip(1))
    assert float(left[1, TURNS > 0].logsumexp(0) - left[1, TURNS < 0].logsumexp(0)) > 1.0


def test_a_face_that_nobody_looks_for_says_nothing():
    nothing = FacePoints(torch.zeros(1, 5, 2), torch.zeros(1, 5), torch.zeros(5, dtype=torch.bool))
    evidence = face_evidence(nothing, STD, DEPTH, TURNS)
    torch.testing.assert_close(evidence, torch.zeros_like(evidence))


def test_a_head_of_which_nothing_is_given_may_be_outside_of_the_image():
    lost = measured(0.0)._replace(
        places=torch.zeros(1, 5, 2), confidence=torch.zeros(1, 5).double()
    )
    evidence = face_evidence(lost, STD, DEPTH, TURNS)[0, 1]
    assert 0 < float(evidence[TURNS.cos() < -0.99] - evidence[TURNS == 0]) < 0.5


@pytest.mark.parametrize("given", ["nothing", "hands", "all but the face"])
def test_a_face_that_is_not_seen_does_not_turn_the_body_round(given):
    """Nobody is seen for a second or more, or their hands alone, or their head is above the image."""
    joints = body(60, turn=0.3)
    face = joints[:, [ROW["head"]]] + face_of(0.3)[0]
    names = [
        "shoulder_left",
        "shoulder_right",
        "elbow_left",
        "elbow_right",
        "hand_left",
        "hand_right",
    ]
    seen = pixels(torch.cat([joints[:, [ROW[name] for name in names]], face], 1), 2.0)
    seen[10:, 6:] = torch.nan
    seen[10:, : {"nothing": 6, "hands": 4}.get(given, 0)] = torch.nan
    tracker = torchpose.UpperBodyTracker(PRIOR, CAMERA, "articulated", fps=30.0, max_gap=None)
    found = tracker(seen[None], names=[*names, *FACE]).joints3d[0]
    across = found[:, ROW["shoulder_left"]] - found[:, ROW["shoulder_right"]]
    turn = torch.atan2(-across[:, 2], across[:, 0])
    assert float((turn - 0.3).cos().min()) > math.cos(math.radians(25))


def test_a_bad_ear_does_not_bring_a_body_near():
    face = measured(0.3)
    face.places[0, 3] += 0.3
    evidence = face_evidence(face, STD, DEPTH, TURNS)
    torch.testing.assert_close(
        evidence.exp().mean(-1), torch.ones_like(evidence[..., 0]), rtol=1e-6, atol=1e-6
    )


def test_unsure_points_count_less():
    right = measured(-0.6)
    wrong = right.places.clone()
    wrong[0, 0, 0] -= 0.1  # a nose that belongs to a head turned the other way

    def change(confidence):
        sure = right.confidence.clone()
        sure[0, 0] = confidence
        pair = (right._replace(places=x, confidence=sure) for x in (right.places, wrong))
        before, after = (face_evidence(x, STD, DEPTH, TURNS)[0, 1].softmax(0) for x in pair)
        return float((before - after).abs().sum())

    assert change(0.05) < 0.5 * change(1.0)


@pytest.mark.parametrize("turn", [-0.9, 0.9, -2.4, 2.4])
def test_shoulders_and_a_face_tell_the_turn(turn):
    """Two shoulders and a neck look the same under a turn and its opposite; the face does not."""
    joints = body(30, turn=turn)
    places, visible = face_of(turn)
    head = joints[:, [ROW["head"]]] + places
    seen = torch.cat([pixels(joints, 2.0), pixels(head, 2.0)], 1)
    seen[:, 8:][:, ~visible] = torch.nan
    rows = [ROW[n] for n in ("shoulder_left", "shoulder_right", "neck")] + list(range(8, 13))
    names = [*UPPER_BODY, *FACE]
    tracker = torchpose.UpperBodyTracker(PRIOR, CAMERA, "articulated", fps=30.0)
    track = tracker(seen[None, :, rows], names=[names[i] for i in rows])
    across = (
        track.joints3d[0, -1, ROW["shoulder_left"]] - track.joints3d[0, -1, ROW["shoulder_right"]]
    )
    found = float(torch.atan2(-across[2], across[0]))
    assert math.cos(found - turn) > math.cos(math.radians(30))


def test_a_stream_with_a_face_gives_the_numbers_of_the_whole_recording():
    joints = body(8, turn=0.7)
    places, _ = face_of(0.7)
    seen = torch.cat([pixels(joints, 2.0), pixels(joints[:, [ROW["head"]]] + places, 2.0)], 1)[None]
    names = [*UPPER_BODY, *FACE]
    tracker = torchpose.UpperBodyTracker(PRIOR, CAMERA, fps=30.0)
    whole = tracker(seen, names=names)
    state = tracker.init(1, names=names)
    for t in range(8):
        state, pose = tracker.step(state, seen[:, t])
        torch.testing.assert_close(pose.joints3d, whole.joints3d[:, t], rtol=0, atol=1e-9)
    without = tracker(seen[:, :, :8], names=UPPER_BODY)
    assert float((whole.joints3d - without.joints3d).abs().max()) > 1e-3


@pytest.mark.parametrize("degrees", [-60, -20, 0, 35])
def test_the_head_is_above_the_middle_of_the_ears(degrees):
    turn = math.radians(degrees)
    face, depth = measured(turn), torch.tensor([2.5], dtype=torch.float64)
    found, told = head_in_face(face, STD, depth, torch.tensor([turn]).double(), TURNS)
    assert bool(told)
    assert found[0].tolist() == pytest.approx([0.0, -0.03, 2.5], abs=0.02)


def test_no_face_tells_of_no_head():
    nothing = FacePoints(torch.zeros(1, 5, 2), torch.zeros(1, 5), torch.zeros(5, dtype=torch.bool))
    depth = torch.tensor([2.5])
    found, told = head_in_face(nothing, STD.float(), depth, torch.zeros(1), TURNS.float())
    assert not bool(told) and bool(found.isfinite().all())


def test_a_bent_head_is_seen_by_its_face():
    joints = body(40)
    aside = torch.tensor([0.10, 0.02, 0.0], dtype=torch.float64)
    head = joints[:, ROW["head"]] + aside
    points = head[:, None] + HEAD + torch.tensor([0.0, 0.03, 0.0])
    names = [name for name in UPPER_BODY if name != "head"]
    seen = torch.cat([joints[:, [ROW[name] for name in names]], points], 1)
    tracker = torchpose.UpperBodyTracker(PRIOR, CAMERA, "articulated", fps=30.0)
    found = tracker(pixels(seen, 1.0)[None], names=[*names, *FACE]).joints3d[0]
    apart = (found[:, ROW["head"]] - found[:, ROW["neck"]]) - (head - joints[:, ROW["neck"]])
    assert float(apart[10:, :2].norm(dim=-1).mean()) < 0.04
    assert float(aside.norm()) > 0.1
