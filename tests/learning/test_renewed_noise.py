"""Noise that is renewed for a prior: on the recordings that it was fitted to, and on no others."""

from dataclasses import replace

import pytest
import torch

from tests.priors.poses import lowered_neck, poses, recording
from torchpose.errors import InputError
from torchpose.learning._recipes import UpperBodyRecipe
from torchpose.learning._recipes.earlier import renew_noise
from torchpose.priors import UpperBodyPrior

RECORDED = [recording(poses(200, seed=seed), person=f"p{seed}", fps=30.0) for seed in (1, 2)]
WRISTS = tuple(name.replace("hand", "wrist") for name in RECORDED[0].names)


@pytest.fixture(scope="module")
def prior():
    """A prior without windows, whose fit was ended before it had converged."""
    recipe = UpperBodyRecipe(
        2, 4000, pose_steps=3, window_components=0, calibration_folds=0, seed=3
    )
    return recipe.fit(RECORDED)


def test_the_same_recordings_make_the_same_noise(prior):
    renewed = renew_noise(prior, RECORDED, calibration_folds=0)
    assert renewed.noise.keys() == prior.noise.keys()
    for key, value in prior.noise.items():
        torch.testing.assert_close(renewed.noise[key], value, rtol=0, atol=0)


def test_calibrations_of_the_noise_before_are_dropped(prior):
    before = UpperBodyPrior(prior.left, prior.right, prior.info, dict(prior.noise))
    for mode in ("pose", "pf_walk", "causal"):
        before.set_noise(f"calibration_scale_{mode}", torch.ones(8))
    errors = {"pose": {"p1": 0.1}, "causal": {"p1": 0.2}}
    extra = before.info.extra | {"held_out": errors, "held_out_drawn": {"pf_walk": {"p1": 0.3}}}
    before.info = replace(before.info, extra=extra)
    renewed = renew_noise(before, RECORDED, calibration_folds=0)
    assert [n for n in renewed.noise if n.startswith("calibration")] == ["calibration_scale_causal"]
    assert renewed.info.extra["calibrated"] == ["calibration_scale_causal"]
    assert renewed.info.extra["held_out"] == {"causal": {"p1": 0.2}}
    assert "held_out_drawn" not in renewed.info.extra


def test_a_frame_that_is_left_out_makes_no_others(prior):
    joints = RECORDED[0].joints.clone()
    joints[7] = torch.nan
    renew_noise(prior, [replace(RECORDED[0], joints=joints), RECORDED[1]], calibration_folds=0)


OTHERS = {
    "fewer frames": (
        {"joints": lambda joints: joints[:190]},
        "expected 400 frames with a whole arm, got 380",
    ),
    "twice the rate": ({"fps": 60.0}, "expected 30 frames per second, got 60"),
    "wrists": ({"names": WRISTS}, "the hand to be of the kind 'hand', got wrist"),
    "another neck": (
        {"joints": lowered_neck},
        "the neck to be of the kind 'neck', got mid-shoulder",
    ),
    "mirrored": (
        {"joints": lambda joints: joints * joints.new_tensor([-1, 1, 1])},
        "log-likelihood of ",
    ),
    "a tenth larger": ({"joints": lambda joints: joints * 1.1}, "log-likelihood of "),
}


@pytest.mark.parametrize("case", OTHERS)
def test_other_recordings_of_the_same_persons_are_refused(prior, case):
    changes, message = OTHERS[case]
    changed = {k: v(RECORDED[0].joints) if callable(v) else v for k, v in changes.items()}
    others = [replace(RECORDED[0], **changed), replace(RECORDED[1], **changed)]
    with pytest.raises(InputError, match=message):
        renew_noise(prior, others, calibration_folds=0)


def test_other_numbers_of_recordings_are_refused(prior):
    halves = [replace(RECORDED[0], joints=part) for part in RECORDED[0].joints.split(100)]
    with pytest.raises(InputError, match="expected 2 recordings, got 3"):
        renew_noise(prior, [*halves, RECORDED[1]], calibration_folds=0)
