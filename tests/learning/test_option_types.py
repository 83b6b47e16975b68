"""The options that a function hands on are those of what it hands them to."""

import inspect
from dataclasses import fields

import pytest

from torchpose.learning import UpperBodyRecipe
from torchpose.learning._recipes.settings import RecipeSettings
from torchpose.learning._streamed_em import StartOptions, StreamedEM
from torchpose.learning._upper_body_prior_fit import MixtureFitOptions
from torchpose.priors import GaussianMixture
from torchpose.priors._facts import FitFacts, ManifoldFacts
from torchpose.priors._limb_conditionals import LimbInfo
from torchpose.priors._manifold.manifold_file import ManifoldInfo


def names(function):
    return set(inspect.signature(function).parameters)


def field_names(info):
    return {field.name for field in fields(info)}


@pytest.mark.parametrize(
    ("options", "taken", "given_otherwise"),
    [
        (StartOptions, names(StreamedEM.start), {"source", "n_components", "seed"}),
        (MixtureFitOptions, names(GaussianMixture.fit),
         {"x", "n_components", "seed", "sample_weight", "progress"}),
        (RecipeSettings, field_names(UpperBodyRecipe), {"n_components", "seed", "views"}),
        (FitFacts, field_names(LimbInfo), {"parts", "fps", "fitted_fps", "n_frames"}),
        (ManifoldFacts, field_names(ManifoldInfo), {"skeleton", "columns", "frame", "centres"}),
    ],
)  # fmt: skip
def test_the_types_name_what_is_taken(options, taken, given_otherwise):
    assert set(options.__annotations__) == taken - given_otherwise
