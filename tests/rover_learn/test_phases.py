"""What distilling and finetuning share: a recipe of checked numbers, and phases of a given number of steps."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from rover_learn.distill import DistillRecipe
from rover_learn.finetune import FinetuneRecipe
from rover_learn.training import Resumable
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.params import params

RECIPES = pytest.mark.parametrize("kind", [DistillRecipe, FinetuneRecipe])


@pytest.mark.parametrize(
    ("kind", "values", "says"),
    [
        (DistillRecipe, {"seed": -1}, "distill: seed must be at least 0"),
        (DistillRecipe, {"batch": 0}, "batch must be at least 1"),
        (DistillRecipe, {"judged_frames": 0}, "judged_frames must be at least 1"),
        (DistillRecipe, {"qat_steps": -1}, "qat_steps must be at least 0"),
        (DistillRecipe, {"rate": 0.0}, "rate must be above 0"),
        (DistillRecipe, {"rate": math.nan}, "rate must be a finite number"),
        (DistillRecipe, {"to_teacher": 0.0, "to_recorded": 0.0}, "not both be 0"),
        (DistillRecipe, {"rate": "2e-4"}, "rate must be a finite number, found '2e-4'"),  # YAML reads 2e-4 as text
        (DistillRecipe, {"samples": 10.5}, "samples must be a whole number"),
        (DistillRecipe, {"lessons": 3}, "there is no 'lessons'"),
        (FinetuneRecipe, {"correction_weight": 0.0}, "finetune: correction_weight must be above 0"),
        (FinetuneRecipe, {"correction_weight": math.inf}, "correction_weight must be a finite number"),
        (FinetuneRecipe, {"focus": -1.0}, "focus must be at least 0"),
        (FinetuneRecipe, {"to_parent": 1.5}, "to_parent must be from 0 to 1"),
        (FinetuneRecipe, {"held_out_share": 1.0}, "held_out_share must be from 0 to below 1"),
    ],
)
def test_a_recipe_that_cannot_be_is_refused(kind, values, says):
    with pytest.raises(kind.ERROR, match=says):
        kind.of({kind.SECTION: {**params()[kind.SECTION], **values}})


@RECIPES
def test_of_no_steps_and_of_missing_numbers_there_is_no_recipe(kind):
    with pytest.raises(kind.ERROR, match="at least 1 step"):
        kind.of(params(), steps=0)
    with pytest.raises(RoverError, match="batch is missing"):
        kind.of({kind.SECTION: {k: v for k, v in params()[kind.SECTION].items() if k != "batch"}})


@RECIPES
@pytest.mark.parametrize("steps", [1, 10, 1000])
def test_a_recipe_of_few_steps_keeps_all_phases(kind, steps):
    recipe = replace(kind.of(params()), **{f"{name}_steps": 7 for name in kind.PHASES})
    counts = [getattr(recipe.of_steps(steps), f"{name}_steps") for name in kind.PHASES]
    assert min(counts) >= 1 and abs(sum(counts) - steps) <= len(kind.PHASES)


def test_a_phase_of_no_steps_makes_its_optimiser_and_changes_nothing(tmp_path):
    module, rng = torch.nn.Linear(1, 1), np.random.default_rng(0)
    before = module.weight.clone()
    with Resumable(tmp_path) as saved:
        saved.train("none", 0, 1e-3, module, rng, lambda: pytest.fail("a step was done"))
    assert torch.equal(module.weight, before)
