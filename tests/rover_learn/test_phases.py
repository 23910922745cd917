"""What trainings share: recipes of checked numbers, and phases of a given number of steps."""

import pytest

from rover_learn.distill import DistillRecipe
from rover_learn.finetune import FinetuneRecipe
from rover_learn.train import TrainingRecipe
from rover_lib.onboard.errors import TrainingError


@pytest.mark.parametrize(
    "wrong",  # YAML reads 2e-4 as text
    [{"seed": -1}, {"batch": 0}, {"rate": "2e-4"}, {"samples": 10.5}, {"lessons": 3}, {"steps": 0}, {"to_parent": 1.5}],
)
def test_a_recipe_that_cannot_be_is_refused(wrong):
    with pytest.raises(TrainingError):
        FinetuneRecipe.of(**wrong)


@pytest.mark.parametrize("steps", [1, 10, 1000])
def test_a_recipe_of_few_steps_keeps_all_phases(steps):
    trainings = (TrainingRecipe.of(*of) for of in (("small", "cpu"), ("full", "cpu"), ("full", "cuda")))
    for recipe in (DistillRecipe.of(), FinetuneRecipe.of(), *trainings):
        planned, counts = ([getattr(r, f"{name}_steps") for name in r.PHASES] for r in (recipe, recipe.of_steps(steps)))
        assert [count > 0 for count in counts] == [count > 0 for count in planned]
        assert abs(sum(counts) - steps) <= len(counts)


def test_a_recipe_of_two_steps_by_hand():
    recipe = TrainingRecipe.of("small", "cpu")
    few = recipe.of_few(2)
    assert (few.samples, few.judged, few.batch, few.feature_samples) == (4 * recipe.batch, 8, 2, 4)


def test_a_gpus_recipe_is_longer_and_what_lacks_a_number_is_refused(set_params):
    set_params("train: {small: {batch: 0}}")
    assert TrainingRecipe.of("full", "cuda").transformer_steps > TrainingRecipe.of("full", "cpu").transformer_steps
    for read in (lambda: TrainingRecipe.of("small", "cpu"), lambda: DistillRecipe.read("distill", {"samples": 3})):
        with pytest.raises(TrainingError):
            read()
