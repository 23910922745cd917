"""What trainings share: recipes of checked numbers, and phases of a given number of steps."""

import math
from dataclasses import replace

import pytest

from rover_learn.distill import DistillRecipe, phases_of
from rover_learn.finetune import FinetuneRecipe
from rover_learn.student import StudentShape
from rover_learn.train import TrainingRecipe
from rover_lib.onboard.errors import TrainingError
from rover_lib.onboard.params import params

SHAPE = StudentShape(54, 96, decoder_layers=1, feedforward=64)


@pytest.mark.parametrize(
    ("kind", "name", "value"),
    [
        (DistillRecipe, "seed", -1),
        (DistillRecipe, "batch", 0),
        (DistillRecipe, "qat_steps", -1),
        (DistillRecipe, "rate", 0.0),
        (DistillRecipe, "rate", "2e-4"),  # YAML reads 2e-4 as text
        (DistillRecipe, "samples", 10.5),
        (DistillRecipe, "lessons", 3),
        (FinetuneRecipe, "correction_weight", math.inf),
        (FinetuneRecipe, "to_parent", 1.5),
        (FinetuneRecipe, "held_out_share", 1.0),
    ],
)
def test_a_recipe_that_cannot_be_is_refused(kind, name, value):
    with pytest.raises(kind.ERROR, match=f"{kind.SECTION}: {name}"):
        kind.of({kind.SECTION: {**params()[kind.SECTION], name: value}})


def test_of_no_steps_of_missing_numbers_and_of_no_loss_there_is_no_recipe():
    given = params()["distill"]
    for wrong in ({k: v for k, v in given.items() if k != "batch"}, given | {"to_teacher": 0.0, "to_recorded": 0.0}):
        with pytest.raises(DistillRecipe.ERROR):
            DistillRecipe.of({"distill": wrong})
    with pytest.raises(DistillRecipe.ERROR, match="at least 1 step"):
        DistillRecipe.of(params(), steps=0)


@pytest.mark.parametrize("steps", [1, 10, 1000])
def test_a_recipe_of_few_steps_keeps_all_phases(steps):
    for kind in (DistillRecipe, FinetuneRecipe):
        recipe = replace(kind.of(params()), **{f"{name}_steps": 7 for name in kind.PHASES})
        counts = [getattr(recipe.of_steps(steps), f"{name}_steps") for name in kind.PHASES]
        assert min(counts) >= 1 and abs(sum(counts) - steps) <= len(kind.PHASES)
    for size, device in (("small", "cpu"), ("full", "cpu"), ("full", "cuda")):
        recipe = TrainingRecipe.of(size, device)
        short = recipe.of_steps(steps)
        counts = [short.backbone_steps, short.transformer_steps, short.together_steps]
        counts += [short.carry_steps] if recipe.carry_steps else []
        assert (
            min(counts) >= 1 and abs(sum(counts) - steps) <= 4 and bool(short.carry_steps) == bool(recipe.carry_steps)
        )


def test_a_gpus_recipe_is_longer_and_a_wrong_one_is_refused(tmp_path, monkeypatch):
    assert TrainingRecipe.of("full", "cuda").transformer_steps > TrainingRecipe.of("full", "cpu").transformer_steps
    for wrong in ("lessons: 3", "batch: 0", "samples: -1"):
        (tmp_path / "params.yml").write_text(f"train: {{small: {{{wrong}}}}}")
        monkeypatch.setenv("ROVER_PARAMS", str(tmp_path / "params.yml"))
        with pytest.raises(TrainingError, match="train: small"):
            TrainingRecipe.of("small", "cpu")


@pytest.mark.parametrize(
    ("shape", "qat", "phases"),
    [
        (SHAPE, True, {"backbone", "transformer", "together", "qat"}),
        (StudentShape(decoder_layers=1), False, {"transformer", "together"}),
        (StudentShape(), True, {"qat"}),
    ],
)
def test_steps_are_shared_by_the_phases_that_it_learns_in(shape, qat, phases):
    short = DistillRecipe.of(params(), steps=1000, phases=phases_of(shape, qat))
    counts = {phase: getattr(short, f"{phase}_steps") for phase in DistillRecipe.PHASES}
    assert {phase for phase, steps in counts.items() if steps} == phases
    assert abs(sum(counts.values()) - 1000) <= len(phases)
