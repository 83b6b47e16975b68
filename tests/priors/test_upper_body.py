"""The pair of arm priors: fit, file and its damages, released priors, names, model card."""

import json

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from tests.data import data_dir_or_skip
from tests.priors.mixtures import random_mixture
from tests.priors.poses import poses, recording
from torchpose.camera import PinholeCamera
from torchpose.errors import (
    CameraError,
    FileFormatError,
    InputError,
    OutputError,
    OverlapError,
    PriorError,
)
from torchpose.learning import fit_upper_body_prior
from torchpose.learning._model_card import card_table, model_card, write_model_card
from torchpose.learning._samplers import all_samples
from torchpose.learning._training import arm_sources, collect_poses
from torchpose.priors import GaussianMixture, UpperBodyPrior, known_priors, load_prior
from torchpose.priors import _upper_body_prior as module
from torchpose.priors._prior_file import PriorInfo


@pytest.fixture(scope="module")
def prior():
    return fit_upper_body_prior(
        [recording(), recording(poses(100, 1), "p2")],
        3, n_samples=2000, name="small", licence="MIT", command="fit", max_iter=20,
    )  # fmt: skip


@pytest.fixture
def saved(prior, tmp_path):
    path = tmp_path / "small.safetensors"
    prior.set_noise("process_cov_left", torch.arange(21.0, dtype=torch.float64))
    prior.set_noise("measurement_std", torch.full((4,), 3.0, dtype=torch.float64))
    prior.save(path)
    return path


def rewrite(path, change):
    """Save the file again with another header."""
    from safetensors import safe_open

    with safe_open(path, framework="pt") as file:
        header = json.loads(file.metadata()["torchpose"])
    change(header)
    save_file(load_file(path), path, metadata={"torchpose": json.dumps(header)})


def change_info(**values):
    def change(header):
        header["info"] = json.dumps(json.loads(header["info"]) | values)

    return change


def test_fit_mirrors_and_says_what_it_was_fitted_on(prior):
    info = prior.info
    assert prior.left.n_components == prior.right.n_components == 3
    assert info.persons == ("site:set#p1", "site:set#p2") and info.n_frames == 400
    assert info.n_samples == 2000 and info.mirrored and info.views["tz"] == (1.5, 2.5)
    torch.testing.assert_close(module.mirror_mixture(prior.right, info.cx).means, prior.left.means)
    torch.testing.assert_close(prior.mirrored().left.means, prior.left.means)
    assert info.extra["fit"]["iterations"] == prior.left.fit_report.iterations


def test_fit_follows_its_seed_and_fits_arms_apart():
    options = {"n_components": 2, "n_samples": 500, "max_iter": 3}
    same = [fit_upper_body_prior([recording()], seed=1, **options) for _ in range(2)]
    assert torch.equal(same[0].left.means, same[1].left.means)
    apart = fit_upper_body_prior([recording()], mirror=False, **options)
    mirrored = module.mirror_mixture(apart.left, apart.info.cx)
    assert not torch.allclose(apart.right.means, mirrored.means)
    # the right hand is at smaller u
    assert float(apart.right.means[:, 0].mean()) < 319 < float(apart.left.means[:, 0].mean())


def test_prior_explains_new_poses_better_than_shifted_ones(prior):
    fresh = collect_poses([recording(poses(200, 9))])
    x = all_samples(arm_sources(fresh, prior.info.matrix, n_samples=500).left).states
    shifted = x + 5 * torch.eye(21, dtype=x.dtype)[0]  # the hand five pixels to one side
    moved = x.clone()
    moved[:, 14] += 0.05  # the neck 5 cm away from where the camera is said to be
    own = prior.left.log_prob(x).mean()
    assert float(own) > float(prior.left.log_prob(shifted).mean())
    assert float(own) > float(prior.left.log_prob(moved).mean()) + 10


def test_files_hold_triangles_and_older_ones_with_whole_covariances_are_read(saved, prior):
    triangles = load_file(saved)["left.covariances"]
    assert triangles.shape == (3, 21 * 22 // 2)
    whole = load_file(saved) | {"left.covariances": prior.left.covariances}
    from safetensors import safe_open

    with safe_open(saved, framework="pt") as file:
        header = json.loads(file.metadata()["torchpose"])
    save_file(whole, saved, metadata={"torchpose": json.dumps(header | {"version": 1})})
    assert torch.equal(UpperBodyPrior.load(saved).left.covariances, prior.left.covariances)
    save_file(
        whole | {"left.covariances": triangles[:, 1:].clone()}, saved,
        metadata={"torchpose": json.dumps(header)},
    )  # fmt: skip
    with pytest.raises(FileFormatError, match="triangles"):
        UpperBodyPrior.load(saved)


def test_round_trip(saved, prior):
    loaded = UpperBodyPrior.load(saved)
    assert loaded.info == prior.info
    for side in ("left", "right"):
        mine, theirs = getattr(prior, side), getattr(loaded, side)
        for a, b in zip(mine.parameters_tuple(), theirs.parameters_tuple(), strict=True):
            torch.testing.assert_close(a, b, rtol=1e-15, atol=0)
    assert loaded.noise.keys() == prior.noise.keys()
    assert torch.equal(loaded.noise["measurement_std"], prior.noise["measurement_std"])


def test_saving_twice_gives_the_same_bytes_and_leaves_nothing_else(saved, prior):
    before = saved.read_bytes()
    prior.save(saved)
    assert saved.read_bytes() == before
    assert [p.name for p in saved.parent.iterdir()] == [saved.name]


def test_a_failed_save_keeps_the_old_file(saved, prior, monkeypatch):
    before = saved.read_bytes()

    def full(*_args, **_options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("torchpose._core.tensor_file.save_file", full)
    with pytest.raises(OutputError, match="No space left"):
        prior.save(saved)
    assert saved.read_bytes() == before
    assert [p.name for p in saved.parent.iterdir()] == [saved.name]


@pytest.mark.parametrize("keep", [0, 4, 100, -1000])
def test_truncated_files_are_refused(saved, keep):
    saved.write_bytes(saved.read_bytes()[:keep])
    with pytest.raises(FileFormatError, match=r"small\.safetensors"):
        UpperBodyPrior.load(saved)


def test_foreign_files_are_refused(saved, tmp_path):
    text = tmp_path / "text.safetensors"
    text.write_text("a prior, honestly" * 100)
    other = tmp_path / "other.safetensors"
    save_file({"a": torch.zeros(2)}, other)
    bad_header = tmp_path / "bad.safetensors"
    save_file({"a": torch.zeros(2)}, bad_header, metadata={"torchpose": "{"})
    for path in (text, other, bad_header):
        with pytest.raises(FileFormatError):
            load_prior(path)


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        (lambda h: h.update(version=3), FileFormatError, "version 2"),
        (lambda h: h.update(format="other"), FileFormatError, "another kind"),
        (lambda h: h.update(info="[]"), FileFormatError, "JSON"),
        (change_info(colour="red"), FileFormatError, "colour"),
        (change_info(fx="wide"), FileFormatError, "fx"),
        (change_info(persons="me"), FileFormatError, "persons"),
        (change_info(fx=-1.0), CameraError, "focal|positive"),
        (change_info(skeleton="hand-21"), PriorError, "hand-21"),
        (change_info(rotation_order="xyz"), PriorError, "xyz"),
        (change_info(centre="hip"), PriorError, "hip"),
    ],
)
def test_other_headers_are_refused(saved, change, error, match):
    rewrite(saved, change)
    with pytest.raises(error, match=match):
        UpperBodyPrior.load(saved)


def test_damaged_tensors_are_refused(saved):
    from safetensors import safe_open

    with safe_open(saved, framework="pt") as file:
        metadata = file.metadata()
    tensors = load_file(saved)
    broken = dict(tensors)
    broken["left.covariances"] = -tensors["left.covariances"]
    save_file(broken, saved, metadata=metadata)
    with pytest.raises(FileFormatError, match="the left mixture is damaged"):
        UpperBodyPrior.load(saved)
    del broken["left.covariances"]
    save_file(broken, saved, metadata=metadata)
    with pytest.raises(FileFormatError, match=r"left\.covariances"):
        UpperBodyPrior.load(saved)


def test_names_are_looked_up(saved, monkeypatch):
    monkeypatch.setattr(module, "WEIGHTS", saved.parent)
    assert known_priors() == ["small"]
    assert load_prior("small").info.name == "small"
    assert load_prior(saved).info.name == "small"
    with pytest.raises(PriorError, match=r"\(small\).*got 'large'"):
        load_prior("large")


def test_missing_file_is_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        UpperBodyPrior.load(tmp_path / "none.safetensors")


def test_noise_is_buffers(prior):
    fresh = UpperBodyPrior(prior.left, prior.right)
    fresh.set_noise("gamma", torch.ones(3))
    assert "noise_gamma" in fresh.state_dict() and set(fresh.noise) == {"gamma"}
    fresh.set_noise("gamma", torch.zeros(3))
    assert float(fresh.noise["gamma"].sum()) == 0
    for name, value in (("a b", torch.ones(1)), ("a", torch.tensor([torch.nan])),
                        ("a", torch.tensor([1])), ("a", 1.0)):  # fmt: skip
        with pytest.raises(InputError):
            fresh.set_noise(name, value)


def test_mirrored_prior_swaps_noise_of_the_sides(prior):
    noise = {"process_cov_left": torch.ones(21), "process_cov_right": torch.zeros(21)}
    swapped = UpperBodyPrior(prior.left, prior.right, prior.info, noise).mirrored()
    assert float(swapped.noise["process_cov_left"].sum()) == 0
    assert float(swapped.noise["process_cov_right"].sum()) == 21


def test_seen_persons_are_refused(prior):
    prior.check_unseen(["site:set#p3"])
    with pytest.raises(OverlapError, match="site:set#p2"):
        prior.check_unseen(["site:set#p3", "site:set#p2"])


def test_mixtures_of_another_size_are_refused(prior):
    with pytest.raises(PriorError, match="right mixture must be over the 21"):
        UpperBodyPrior(prior.left, random_mixture())


def test_bad_settings_are_refused():
    with pytest.raises(PriorError, match="rotation order"):
        fit_upper_body_prior([recording()], 2, rotation_order="xyz")
    skewed = PinholeCamera(500, 500, 320, 240, skew=1.0)
    with pytest.raises(PriorError, match="skew"):
        fit_upper_body_prior([recording()], 2, camera=skewed)
    with pytest.raises(PriorError, match="JSON"):
        mixture = GaussianMixture.fit(torch.randn(50, 21, dtype=torch.float64), 1)
        info = PriorInfo(extra={"tensor": torch.zeros(1)})
        UpperBodyPrior(mixture, mixture, info).save("never-written.safetensors")


@pytest.mark.data
def test_released_prior(tmp_path):
    path = data_dir_or_skip("signer") / "released_prior_Training20_02.npz"
    prior = UpperBodyPrior.from_released(path)
    info = prior.info
    assert info.rotation_order == "zyx" and info.name == "Training20_02"
    assert info.matrix.tolist() == [[1550, 0, 130], [0, 1550, 105], [0, 0, 1]]
    with np.load(path) as arrays:
        np.testing.assert_array_equal(prior.left.means, arrays["left_means"])
        np.testing.assert_allclose(prior.right.weights, arrays["right_weights"], rtol=1e-11)
    assert prior.noise["process_cov_left"][:4].tolist() == [560, 560, 1, 56]
    prior.save(tmp_path / "released.safetensors")
    loaded = UpperBodyPrior.load(tmp_path / "released.safetensors")
    assert torch.equal(loaded.left.covariances, prior.left.covariances)


@pytest.mark.data
def test_released_prior_is_centred_on_the_head_with_its_neck_between_the_shoulders():
    """What `from_released` says about conventions, read off the component means."""
    from torchpose.camera import lift
    from torchpose.math import euler_to_matrix

    path = data_dir_or_skip("signer") / "released_prior_Training20_02.npz"
    prior = UpperBodyPrior.from_released(path)
    shoulders = []
    for mixture in (prior.left, prior.right):
        mean = mixture.means
        rotation = euler_to_matrix(mean[:, 15:18], "zyx")
        body = lift(mean[:, :15].reshape(-1, 5, 3), prior.info.matrix, rotation, mean[:, 18:])
        body = (mixture.weights[:, None, None] * body).sum(0)
        assert float(body[3].norm()) < 0.02
        shoulders.append(body[2])
        neck = body[4]
    middle = (shoulders[0] + shoulders[1]) / 2
    assert float((neck - middle).norm()) < 0.02


def test_other_npz_is_refused(tmp_path):
    np.savez(tmp_path / "a.npz", left_weights=np.ones(1))
    with pytest.raises(FileFormatError, match="left_means"):
        UpperBodyPrior.from_released(tmp_path / "a.npz")


def test_model_card_says_what_matters(prior, tmp_path):
    path = tmp_path / "card.md"
    write_model_card(prior, path, {"mean 3D error": "5.0 cm"})
    text = path.read_text(encoding="utf-8")
    assert text.startswith("# small\n")
    for part in ("site:set#p1", "MIT", "400", "2,000", "zxy", "kind of neck | neck", "5.0 cm",
                 "roll ±15°", "`fit`", "2 persons"):  # fmt: skip
        assert part in text
    assert all(row.count("|") == 3 for row in text.splitlines() if row.startswith("| viewpoints"))
    assert card_table({"licence": "MIT | mine\nalone"}).endswith(r"| licence | MIT \| mine alone |")
    mixture = prior.left
    assert "not stated" in model_card(UpperBodyPrior(mixture, mixture))
