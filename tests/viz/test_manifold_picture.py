"""The picture of a latent space: trajectories where they are, grey where nothing is known."""

import numpy as np
import pytest
import torch

from torchpose.learning import fit_gplvm

pytest.importorskip("matplotlib", reason="matplotlib is not installed")

from tests.priors.motions import motion
from torchpose.body import BODY_15, Body
from torchpose.errors import InputError, PriorError, ShapeError
from torchpose.priors import BackConstrainedGPLVM, ManifoldInfo
from torchpose.viz import plot_manifold, save_figure


@pytest.fixture(scope="module")
def body() -> Body:
    return Body.of_height(BODY_15, 1.8)


@pytest.fixture(scope="module")
def manifold(body) -> BackConstrainedGPLVM:
    info = ManifoldInfo.of_body(body, name="walk", sequences=("a", "b", "a"))
    poses = [motion(80), motion(40, phase=2.0, seed=1), motion(40, phase=1.0, seed=2)]
    return fit_gplvm(poses, steps=5, info=info)


def lines(ax) -> list[np.ndarray]:
    return [line.get_xydata() for line in ax.lines if len(line.get_xydata()) > 1]


def test_trajectories_are_drawn_where_they_are(manifold) -> None:
    figure = plot_manifold(manifold, resolution=30)
    ax = figure.axes[0]
    for drawn, path in zip(lines(ax), manifold.trajectories()[:1], strict=False):
        np.testing.assert_allclose(drawn, path.numpy())
    assert len(lines(ax)) == 3
    colours = {line.get_color() for line in ax.lines}
    assert len(colours) == 2  # sequences of one name share theirs
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["a", "b"]
    assert "walk: 160 frames of 30 columns" in figure.get_suptitle()


def test_it_is_light_where_poses_are_known(manifold) -> None:
    ax = plot_manifold(manifold, resolution=60).axes[0]
    image = ax.images[0]
    grey = np.asarray(image.get_array())
    left, right, bottom, top = image.get_extent()
    at = manifold.latents.numpy()
    columns = ((at[:, 0] - left) / (right - left) * 59).round().astype(int)
    rows = ((at[:, 1] - bottom) / (top - bottom) * 59).round().astype(int)
    corners = grey[[0, 0, -1, -1], [0, -1, 0, -1]]
    assert grey[rows, columns].mean() < 0.5 * corners.mean()


def test_other_poses_and_a_body_are_drawn_too(manifold, body, tmp_path) -> None:
    others = {"held out": motion(50, phase=0.5, seed=7)}
    figure = plot_manifold(manifold, others, body, n_poses=5, resolution=30)
    path = save_figure(figure, tmp_path / "manifold.png", dpi=50)
    assert path.stat().st_size > 5000
    ax = figure.axes[0]
    np.testing.assert_allclose(lines(ax)[-1], manifold.to_latent(others["held out"]).numpy())
    numbers = {text.get_text() for text in ax.texts} & set("12345")
    assert numbers == set("12345")
    bones = figure.axes[1].lines
    assert len(bones) == 5 * (len(BODY_15.names) - 1)


def test_a_cycle_of_few_frames_shows_each_pose_once(body) -> None:
    few = fit_gplvm(motion(60)[::12].repeat(2, 1), steps=1)  # five frames to a cycle
    figure = plot_manifold(few, body=body, n_poses=8, resolution=10)
    numbers = [text.get_text() for text in figure.axes[1].texts]
    shown = int(numbers[-1])
    assert shown < 8 and numbers == [str(i + 1) for i in range(shown)]
    places = {text.xy for text in figure.axes[0].texts if text.get_text() in numbers}
    assert len(places) == shown


def test_sequences_that_are_empty_or_stand_still_are_drawn(body) -> None:
    poses = motion(40)
    for first in (poses[:0], poses[:1].expand(6, -1)):
        figure = plot_manifold(fit_gplvm([first, poses], steps=1), body=body, resolution=5)
        assert len(figure.axes[1].texts) > 1


def test_other_poses_of_a_name_that_was_fitted_are_dashed(manifold) -> None:
    legend = plot_manifold(manifold, {"a": motion(9)}, resolution=5).legends[0]
    dashed = [line.is_dashed() for line in legend.get_lines()]
    assert [text.get_text() for text in legend.get_texts()] == ["a", "b", "a"]
    assert dashed == [False, False, True]


def test_names_that_share_a_colour_have_other_marks() -> None:
    info = ManifoldInfo(name="many", sequences=tuple("abcdefghi"))
    many = fit_gplvm([motion(5, seed=i) for i in range(9)], steps=1, info=info)
    legend = plot_manifold(many, resolution=10).figure.legends[0]
    looks = {(line.get_color(), line.get_marker()) for line in legend.get_lines()}
    assert len(looks) == 9


def test_what_cannot_be_drawn_is_refused(manifold, body) -> None:
    one = fit_gplvm(motion(30), latent_dim=1, steps=1)
    with pytest.raises(InputError, match="needs two dimensions or more, got 1"):
        plot_manifold(one)
    with pytest.raises(InputError, match=r"n_poses must be a whole number, got 2\.5"):
        plot_manifold(manifold, n_poses=2.5)
    with pytest.raises(InputError, match="resolution and n_poses must be at least 2"):
        plot_manifold(manifold, resolution=1)
    with pytest.raises(PriorError, match="frame"):
        plot_manifold(manifold, body=body.altered(frame="body"))
    with pytest.raises(ShapeError, match="x must have shape"):
        plot_manifold(manifold, {"other": torch.zeros(5, 7)})
    for bad in ("walk", manifold.poses):
        with pytest.raises(InputError, match="manifold must be a BackConstrainedGPLVM, got"):
            plot_manifold(bad)
    with pytest.raises(InputError, match="others must go by names"):
        plot_manifold(manifold, motion(9))
    with pytest.raises(InputError, match=r"others\['held out'\] must be a tensor, got ndarray"):
        plot_manifold(manifold, {"held out": motion(9).numpy()})
    with pytest.raises(InputError, match="leave out the frames with gaps"):
        plot_manifold(manifold, {"held out": motion(9) * torch.nan})
    with pytest.raises(InputError, match="body must be a torch"):
        plot_manifold(manifold, body=1.8)


def test_more_than_two_dimensions_show_the_first_two() -> None:
    three = fit_gplvm(motion(40), latent_dim=3, steps=2)
    ax = plot_manifold(three, resolution=20).axes[0]
    np.testing.assert_allclose(lines(ax)[0], three.latents[:, :2].numpy())
