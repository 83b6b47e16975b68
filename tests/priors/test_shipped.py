"""Models of whole bodies that come with the package: files, cards, configurations, and who is refused."""

from pathlib import Path

import pytest
import torch
import yaml

from tests.data import data_dir_or_skip
from torchpose import load_action, load_limb_conditionals, load_manifold
from torchpose.body import BODY_15, Body
from torchpose.cli._fit_bodies import command
from torchpose.errors import InputError, PriorError
from torchpose.learning._model_card import body_card
from torchpose.priors import BackConstrainedGPLVM, known_models
from torchpose.priors._shipped import KINDS, WEIGHTS, find_model, load_body_motion

ROOT = Path(__file__).parents[2]
LOADERS = {
    "manifolds": load_manifold,
    "conditionals": load_limb_conditionals,
    "actions": load_action,
    "bodies": load_body_motion,
}
FITTED_BY = {
    "manifolds": "manifold",
    "conditionals": "limbs",
    "actions": "actions",
    "bodies": "body",
}
SHIPPED = [(kind, name) for kind in KINDS for name in known_models(kind)]
RESULTS = "## On persons that it was not fitted on\n\n"
CHOSEN = "## How its settings were chosen\n\n"


def settings_of(info):
    """The configuration that a model's command names."""
    return yaml.safe_load((ROOT / info.command.split("--config ")[1]).read_text())


def test_every_method_has_a_model():
    assert {kind for kind, _ in SHIPPED} == set(KINDS)
    assert sum(path.stat().st_size for kind in KINDS for path in (WEIGHTS / kind).iterdir()) < 1.5e6


@pytest.mark.parametrize(("kind", "name"), SHIPPED)
def test_its_card_says_what_its_file_says(kind, name):
    model = LOADERS[kind](name)
    info = model.info
    assert info.name == name and info.licence and info.sources
    card = (WEIGHTS / kind / f"{name}.md").read_text(encoding="utf-8")
    results, chosen = (
        card.partition(title)[2].partition("\n\n## ")[0] for title in (RESULTS, CHOSEN)
    )
    assert card == body_card(model, results=results, chosen=chosen)
    if kind != "bodies":
        assert results and "torchpose evaluate" in results
    for person in info.persons:
        assert person.partition("#")[2] in card


@pytest.mark.parametrize(("kind", "name"), SHIPPED)
def test_its_configuration_makes_it_and_holds_persons_out(kind, name):
    info = LOADERS[kind](name).info
    settings = settings_of(info)
    assert settings["out"] == f"torchpose/weights/{kind}/{name}.safetensors"
    assert info.command.startswith(f"torchpose fit {FITTED_BY[kind]} --config configs/bodies/")
    config = ROOT / info.command.split("--config ")[1]
    args = command(FITTED_BY[kind]).given(["--config", str(config)]).values
    assert args["fps"] == info.fps and args["licence"] == info.licence
    fitted = {person.partition("#")[2] for person in info.persons}
    assert settings["held_out"] and not fitted & set(settings["held_out"])


@pytest.mark.slow
@pytest.mark.data
def test_the_manifold_is_made_again_by_its_configuration(tmp_path, torchpose_command, monkeypatch):
    data = data_dir_or_skip("mocap_cmu_walk")
    monkeypatch.setenv("TORCHPOSE_DATA", str(data.parent))
    out = tmp_path / "walk.safetensors"
    kept = load_manifold("walk")
    config = ROOT / kept.info.command.split("--config ")[1]
    torchpose_command("fit", "manifold", "--config", str(config), "--out", str(out))
    again = BackConstrainedGPLVM.load(out)
    assert again.info.extra["steps"] == kept.info.extra["steps"]
    for name, value in kept.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], value, rtol=1e-5, atol=1e-6)


@pytest.fixture
def torchpose_command(monkeypatch):
    from torchpose.cli import main

    def run(*arguments):
        assert main(list(arguments)) == 0

    return run


def test_they_are_of_the_body_that_is_tracked():
    body = Body.of_height(BODY_15, 1.8)
    manifold = load_manifold("walk")
    manifold.check_for(body, 60.0)
    manifold.at_rate(25.0).check_for(body, 25.0)
    with pytest.raises(InputError, match="fps must be positive"):
        manifold.at_rate(0.0)
    for name in known_models("conditionals"):
        limbs = load_limb_conditionals(name)
        limbs.check_for(body.altered(frame="body", centres=limbs.centres))
    bank = load_action("exercises")
    assert bank.names[-1] == "none" and bank.info.extra["postures"] == "body"


def test_names_and_files(tmp_path):
    copy = tmp_path / "mine.safetensors"
    copy.write_bytes(find_model("manifolds", "walk").read_bytes())
    assert load_manifold(copy).info == load_manifold("walk").info
    with pytest.raises(PriorError, match=r"run: no such file.*a manifold \(walk\)"):
        load_manifold("run")
    with pytest.raises(PriorError, match="an action space or bank"):
        load_action("walk")
    with pytest.raises(PriorError, match="a manifold is loaded by its name or file, got Back"):
        load_manifold(load_manifold("walk"))
