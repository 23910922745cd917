"""What trainings share: recipes of checked numbers, and phases of a given number of steps."""

from dataclasses import replace

import pytest

from rover_learn.distill import DistillRecipe, phases_of
from rover_learn.finetune import FinetuneRecipe
from rover_learn.student import StudentShape
from rover_learn.train import TrainingRecipe
from rover_lib.onboard.errors import TrainingError


@pytest.mark.parametrize(
    "wrong",  # YAML reads 2e-4 as text
    [{"seed": -1}, {"batch": 0}, {"rate": "2e-4"}, {"samples": 10.5}, {"lessons": 3}, {"steps": 0}, {"to_parent": 1.5}],
)
def test_a_recipe_that_cannot_be_is_refused(wrong):
    with pytest.raises(TrainingError):
        FinetuneRecipe.of(**wrong)
    with pytest.raises(TrainingError, match="missing"):
        DistillRecipe.read("distill", {"samples": 3})


@pytest.mark.parametrize("steps", [1, 10, 1000])
def test_a_recipe_of_few_steps_keeps_all_phases(steps):
    recipes = [
        TrainingRecipe.of(size, device) for size, device in (("small", "cpu"), ("full", "cpu"), ("full", "cuda"))
    ]
    for recipe in (DistillRecipe.of(), FinetuneRecipe.of(), *recipes):
        planned, counts = ([getattr(r, f"{name}_steps") for name in r.PHASES] for r in (recipe, recipe.of_steps(steps)))
        assert [count > 0 for count in counts] == [count > 0 for count in planned]
        assert abs(sum(counts) - steps) <= len(counts)


def test_a_gpus_recipe_is_longer_and_a_wrong_one_is_refused(set_params):
    set_params("train: {small: {batch: 0}}")
    assert TrainingRecipe.of("full", "cuda").transformer_steps > TrainingRecipe.of("full", "cpu").transformer_steps
    with pytest.raises(TrainingError, match="train: small: batch"):
        TrainingRecipe.of("small", "cpu")


def test_steps_are_shared_by_the_phases_that_it_learns_in():
    at_its_size = phases_of(StudentShape(decoder_layers=1))
    assert at_its_size == ["transformer", "together"] and phases_of(StudentShape(54, 96)) == ["backbone", *at_its_size]
    short = DistillRecipe.of(steps=1000, phases=at_its_size)
    assert short.backbone_steps == 0 and abs(short.transformer_steps + short.together_steps - 1000) <= 2
    assert short == replace(DistillRecipe.of(), **{f"{p}_steps": getattr(short, f"{p}_steps") for p in short.PHASES})
