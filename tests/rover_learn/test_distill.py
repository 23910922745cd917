"""A student is taught from recordings alone, and an interrupted training goes on where it stopped."""

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from interrupted import interrupt, save_each_step
from policies import TINY, lerobot_policy, memory_samples, of_a_cars_size, trainer_content
from recorded import record_drives

from rover_learn import distill as distill_module
from rover_learn import training
from rover_learn.distill import DistillRecipe, distill, summary
from rover_learn.fake_quant import Rounded
from rover_learn.student import StudentShape, student_config
from rover_lib.onboard.errors import DistillError, RoverError, TrainingError
from rover_lib.onboard.params import params
from rover_lib.onboard.policy.load import load_policy
from rover_lib.workshop.act import ACT, Affine, inputs_of
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint
from rover_lib.workshop.checkpoint.files import write_lerobot
from rover_lib.workshop.int8.choose import Chooser
from rover_lib.workshop.int8.observe import RangeObserver, restore_observed
from rover_lib.workshop.int8.scheme import Scheme
from rover_lib.workshop.judge.compare import LerobotEager
from rover_lib.workshop.progress import silent
from rover_lib.workshop.run import session
from rover_lib.workshop.run.session import load

SHAPE = StudentShape(54, 96, decoder_layers=1, feedforward=64)


@pytest.fixture(scope="module")
def episodes(tmp_path_factory):
    return record_drives(tmp_path_factory.mktemp("episodes"))


@pytest.fixture(scope="module")
def teacher(tmp_path_factory):
    return of_a_cars_size(tmp_path_factory.mktemp("teacher") / "best_model.pth")


@pytest.fixture(scope="module")
def recipe():
    few = {"samples": 20, "batch": 4, "unit_frames": 8, "judged_frames": 8, "rate": 1e-3}
    steps = {"backbone_steps": 3, "transformer_steps": 8, "together_steps": 3, "qat_steps": 3}
    return DistillRecipe(**{**params()["distill"], **steps, **few})


@pytest.fixture(scope="module", autouse=True)
def few_samples(set_params):
    """Eight samples calibrate a student, instead of all."""
    set_params("calibration: {samples: 8}")


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    """Each test has a cache of its own. Of all students `taught` alone chooses its observer, by three quantizations."""
    monkeypatch.setenv("ROVER_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(Chooser, "observer", lambda self, scheme, *_: (replace(scheme, observer="minmax"), {}))


@pytest.fixture(scope="module")
def taught(teacher, episodes, recipe, tmp_path_factory):
    folder = tmp_path_factory.mktemp("taught")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROVER_CACHE", str(folder / "cache"))
        return distill(teacher, episodes, "fast", SHAPE, runs_dir=folder, recipe=recipe, device="cpu")


def weights_of(folder):
    return load_checkpoint(folder / "best_model.pth").weights


@pytest.mark.slow
def test_what_is_left_is_one_policy_in_two_formats(taught, teacher):
    ours, lerobots = load_checkpoint(taught / "best_model.pth"), load_checkpoint(taught / "pretrained_model")
    assert ours.config.image_sizes == lerobots.config.image_sizes == ((54, 96),)
    assert (ours.config.decoder_layers, ours.config.feedforward) == (1, 64)
    assert all(torch.equal(weight, lerobots.weights[name]) for name, weight in ours.weights.items())
    origin = json.loads((taught / "pretrained_model" / "origin.json").read_text())
    assert origin == ours.report["trainer_config"]["origin"] | {"rate_hz": 30.0}
    assert origin["teacher_sha256"] == load_checkpoint(teacher).sha256
    assert origin["distilled_by"]["transformer_steps"] == 8
    files = ["best_model.pth", "distill.json", "policy_static.pt", "pretrained_model"]
    assert sorted(p.name for p in taught.iterdir()) == files
    manifest = load_policy(taught / "policy_static.pt").manifest
    assert (manifest["mode"], manifest["checkpoint"]["sha256"]) == ("static", ours.sha256)


@pytest.mark.slow
def test_distill_json_judges_it_on_held_out_episodes(taught):
    content = json.loads((taught / "distill.json").read_text())
    of_teacher, of_student = content["metrics"]["students"]
    assert of_teacher["teacher_steering_pct"] == of_teacher["teacher_throttle_pct"] == 0
    assert of_student["teacher_steering_pct"] > 0 and of_student["gmac"] < of_teacher["gmac"]
    assert (of_student["width"], of_student["decoder_layers"], of_student["feedforward"]) == (96, 1, 64)
    assert {phase: len(losses) for phase, losses in content["metrics"]["losses"].items() if losses} == {
        "backbone": 3,
        "transformer": 8,
        "together": 3,
    }
    assert "nobody drove" in content["metrics"]["note"]
    assert "nobody drove" in summary(content) and "96x54, 1 decoder layer" in summary(content)
    assert len(content["inputs"]) > 4 * 24


def test_what_was_begun_with_other_settings_is_not_gone_on_with(teacher, episodes, recipe, tmp_path, monkeypatch):
    """With the ranges of another calibration, training would round otherwise than the export does."""
    opened, places = load(teacher, episodes), []

    class Elsewhere(distill_module.Resumable):
        def __enter__(self):
            places.append(self.folder.name)
            if len(places) % 2 == 0:
                raise KeyboardInterrupt
            return super().__enter__()

    monkeypatch.setattr(distill_module, "Resumable", Elsewhere)
    monkeypatch.setattr(distill_module, "_train_backbone", lambda *_: {})
    monkeypatch.setattr(distill_module.Lessons, "refuse_stranger", lambda *_: None)
    monkeypatch.setattr(distill_module.Lessons, "ask", lambda *_: None)
    (tmp_path / "other.yml").write_text("quantization: {smooth: 0.3}")
    config = student_config(opened.checkpoint, SHAPE)
    cpu = torch.device("cpu")
    for qat in (True, False):
        work = distill_module._Work(
            origin=opened.checkpoint, opened=opened, config=config, share=None, recipe=recipe, qat=qat, device=cpu,
            progress=silent,
        )  # fmt: skip
        for settings in ("", str(tmp_path / "other.yml")):
            monkeypatch.setenv("ROVER_PARAMS", settings)
            with pytest.raises(KeyboardInterrupt):
                distill_module._teach(work)
    lessons, students = places[::2], places[1::2]
    assert len(set(lessons)) == 1
    assert students[0] != students[1] and students[2] == students[3]  # the settings matter only with QAT


@pytest.mark.slow
def test_int8s_training_begins_from_the_ranges_that_were_chosen(tiny, calibration, tmp_path, monkeypatch):
    """With others, all that it learned would be against a rounding that the export does not do."""
    chosen = Scheme(observer="frames", usual_pct=50.0, wider=(("image_project", 0.5),))
    observed = restore_observed(tiny, chosen, calibration)
    ranges = {m.calculate_qparams()[0].item() for m in observed.modules() if isinstance(m, RangeObserver)}
    chooser = SimpleNamespace(observer=lambda *_: (chosen, {}))
    monkeypatch.setattr(distill_module, "calibrate", lambda *_, **__: calibration)
    monkeypatch.setattr(distill_module.quantization, "prepare_chooser", lambda *_: chooser)
    monkeypatch.setattr(distill_module, "_checkpoint", lambda *_: tiny)
    found = []

    def see(policy, _):
        found.extend(m.scale for m in policy.modules() if isinstance(m, Rounded))
        raise KeyboardInterrupt

    monkeypatch.setattr(distill_module.RoundedPolicy, "to", see)
    opened = SimpleNamespace(parts=SimpleNamespace(calibration=memory_samples(4)))
    work = SimpleNamespace(opened=opened, config=tiny.config, progress=silent, device="cpu")
    policy = SimpleNamespace(weights=dict)
    for _ in range(2):  # the second time from what was kept
        with pytest.raises(KeyboardInterrupt):
            distill_module._train_rounded(work, None, policy, None, tmp_path)
        assert set(found) < ranges and len(ranges) - len(set(found)) == 1  # pixels are their own INT8
        found.clear()


@pytest.mark.slow
def test_killed_twice_in_the_middle_it_goes_on_and_gives_the_same(
    teacher, episodes, recipe, taught, tmp_path, monkeypatch
):
    save_each_step(monkeypatch, distill_module)
    arguments = {"runs_dir": tmp_path, "recipe": recipe, "device": "cpu"}
    for at in (2, 8):  # in the backbone's phase with one step done, and in the transformer's with eight
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            interrupt(patch, training, "descend", at)
            distill(teacher, episodes, "fast", SHAPE, **arguments)
        assert not (tmp_path / "fast").exists()
    steps = interrupt(monkeypatch, training, "descend", at=0)
    folder = distill(teacher, episodes, "fast", SHAPE, **arguments)
    assert len(steps) == 3 + 8 + 3 - 8
    expected = weights_of(taught)
    assert all(torch.equal(weight, expected[name]) for name, weight in weights_of(folder).items())
    losses = [json.loads((f / "distill.json").read_text())["metrics"]["losses"] for f in (folder, taught)]
    assert losses[0] == losses[1]


@pytest.mark.slow
def test_a_student_of_half_the_channels_keeps_its_zeros(teacher, episodes, recipe, tmp_path, monkeypatch):
    """They stay zero in all phases, through an interrupt, up to the INT8 artifact; LeRobot's forward equals ours."""
    shape, arguments = StudentShape(backbone_channels=0.5), {"runs_dir": tmp_path, "recipe": recipe, "device": "cpu"}
    with monkeypatch.context() as patch:
        save_each_step(patch, distill_module)
        steps = interrupt(patch, training, "descend", at=2)
        with pytest.raises(KeyboardInterrupt):
            distill(teacher, episodes, "thin", shape, qat=True, **arguments)
        (own,) = (tmp_path / "cache").glob("student-*")
        began, _ = torch.load(own / "start.pt", weights_only=True)
        folder = distill(teacher, episodes, "thin", shape, qat=True, **arguments)
    assert len(steps) == 8 + 3 + 3 + 1  # no backbone phase, and only the interrupted step is repeated
    ends = load_checkpoint(folder / "pretrained_model")
    for name in (f"backbone.layer{i}.{j}" for i in (1, 2, 3, 4) for j in (0, 1)):
        gone = (began[f"{name}.conv1.weight"] == 0).flatten(1).all(1)
        assert gone.sum() * 2 == len(gone)
        for part in ("conv1.weight", "bn1.weight", "bn1.bias"):
            left = ends.weights[f"{name}.{part}"].reshape(len(gone), -1)
            assert torch.equal(left.any(1), ~gone), part
        assert not torch.equal(ends.weights[f"{name}.conv1.weight"], began[f"{name}.conv1.weight"])
    content = json.loads((folder / "distill.json").read_text())
    of_teacher, of_student = content["metrics"]["students"]
    assert of_student["gmac"] < 0.56 * of_teacher["gmac"] and of_student["backbone_channels"] == 0.5
    assert [note["block"] for note in content["metrics"]["backbone"]][-1] == "backbone.layer4.1"
    assert "50% of the backbone's channels" in summary(content)
    artifact = load_policy(folder / "policy_static.pt")
    assert artifact.manifest["gmac"] == pytest.approx(of_student["gmac"])
    assert (folder / "policy_static.pt").stat().st_size < 8e6  # it has 12 MB with all channels
    sample = session.load(folder / "best_model.pth", episodes).parts.held_out[0]
    lerobots = LerobotEager(ends).predict_chunk(sample.frame_bgr(), sample.state)
    ours = ACT(ends.config, ends.weights)(*inputs_of(sample, ends.config))[0].numpy()
    assert np.abs(ours - lerobots).max() < 1e-5


@pytest.mark.slow
def test_the_teacher_itself_learns_to_be_int8(teacher, episodes, recipe, tmp_path, monkeypatch):
    """Only the QAT phase runs, also after an interrupt in its middle."""
    arguments = {"qat": True, "runs_dir": tmp_path, "recipe": recipe, "device": "cpu"}
    with monkeypatch.context() as patch:
        save_each_step(patch, distill_module)
        steps = interrupt(patch, training, "descend", at=2)
        with pytest.raises(KeyboardInterrupt):
            distill(teacher, episodes, "int8", StudentShape(), **arguments)
        folder = distill(teacher, episodes, "int8", StudentShape(), **arguments)
    assert len(steps) == 3 + 1
    metrics = json.loads((folder / "distill.json").read_text())["metrics"]
    assert {phase for phase, losses in metrics["losses"].items() if losses} == {"qat"}
    of_teacher, of_student = metrics["students"]
    assert of_student["qat"] and not of_teacher["qat"]
    assert load_checkpoint(folder / "best_model.pth").config == replace(load_checkpoint(teacher).config, vae_layers=0)
    for errors in (of_student, metrics["before_qat"]):
        assert errors["int8_steering_pct"] > 0 and errors["int8_teacher_throttle_pct"] > 0
    assert "before quantization-aware training" in summary({"metrics": metrics})


@pytest.mark.slow
def test_what_loses_much_by_int8_is_told_of_qat(taught):
    content = json.loads((taught / "distill.json").read_text())
    (row,) = content["metrics"]["gates"]
    assert row["limit"] == 5 and "--qat" in row["gate"] and row["passed"] == (row["found"] <= 5)
    row |= {"found": 7.25, "passed": False}
    said = "INT8 loses 7.2 % of the recorded range, more than 5 %: "
    assert f"{said}train with --qat" in summary(content)
    content["metrics"]["before_qat"] = content["metrics"]["students"][1]  # it was trained so already
    assert f"{said}--qat was not enough, and `rover run` says where" in summary(content)
    content["metrics"]["odd"] = {"share_pct": 4.0}
    assert f"{said}4 % of the frames are odd, and `rover run` names them" in summary(content)


@pytest.mark.slow
def test_the_next_student_of_the_same_picture_asks_nothing_again(
    teacher, episodes, recipe, taught, tmp_path, monkeypatch
):
    arguments = {"runs_dir": tmp_path, "recipe": recipe, "device": "cpu"}
    shutil.copytree(taught.parent / "cache", tmp_path / "cache")
    steps = interrupt(monkeypatch, training, "descend", at=0)
    distill(teacher, episodes, "second", replace(SHAPE, decoder_layers=2), **arguments)
    assert len(steps) == 8 + 3  # no backbone phase
    assert [p.name.split("-")[0] for p in (tmp_path / "cache").iterdir()] == ["lessons"]


@pytest.mark.slow
def test_a_teacher_with_other_statistics_is_asked_again(teacher, episodes, recipe, tmp_path, monkeypatch):
    """The weights did not change, but the cache holds what the teacher planned with the wrong statistics."""
    was = load_checkpoint(teacher)
    plans, rows = [], np.arange(2 * recipe.samples)
    monkeypatch.setattr(distill_module.Lessons, "refuse_stranger", lambda self, *_: plans.append(self.plans[rows]))
    for shift in (0.0, 0.02, 0.02):
        config = replace(was.config, action_unnorm=Affine((1.0, 1.0), (0.0, shift)))
        write_lerobot(tmp_path / "teacher", config, was.weights, {})
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            interrupt(patch, distill_module, "_train_backbone")
            distill(tmp_path / "teacher", episodes, "fast", SHAPE, runs_dir=tmp_path, recipe=recipe, device="cpu")
    before, corrected, again = plans
    assert corrected[..., 1] - before[..., 1] == pytest.approx(0.02, abs=1e-6)
    assert np.array_equal(corrected, again)


@pytest.mark.slow
def test_it_learns_what_its_teacher_plans(teacher, episodes, recipe, tmp_path):
    longer = replace(recipe, backbone_steps=1, transformer_steps=60, together_steps=1, to_recorded=0.0)
    folder = distill(teacher, episodes, "fast", SHAPE, runs_dir=tmp_path, recipe=longer, device="cpu")
    losses = json.loads((folder / "distill.json").read_text())["metrics"]["losses"]["transformer"]
    assert np.mean(losses[-10:]) < 0.5 * np.mean(losses[:3])


def test_an_earlier_students_files_go_and_the_users_stay(teacher, episodes, tmp_path, monkeypatch):
    """A student of another rate has no best_model.pth, whose format lacks a rate; the old student's must not stay."""
    monkeypatch.setattr(distill_module, "_is_student", lambda path: True)
    monkeypatch.setattr(distill_module, "_teach", lambda work: SimpleNamespace(folder=tmp_path / "gone"))
    monkeypatch.setattr(distill_module, "_leave", lambda new, *_: (new / "pretrained_model").mkdir())
    old = ("best_model.pth", "pretrained_model/config.json", "policy_static.pt", "policy_static.onnx.zip",
           "compare.json", "report.html", "policy_mixed.pt", "figures/01.png", "notes.txt")  # fmt: skip
    for name in old:
        (tmp_path / "fast" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "fast" / name).touch()
    folder = distill(teacher, episodes, "fast", SHAPE, runs_dir=tmp_path, device="cpu")
    assert {p.name for p in folder.rglob("*")} == {"pretrained_model", "notes.txt"}


@pytest.mark.slow
def test_a_teacher_of_another_car_is_refused(episodes, recipe, tmp_path):
    policy = lerobot_policy(**TINY)
    with torch.no_grad():
        policy.model.action_head.weight.zero_()
        policy.model.action_head.bias.copy_(torch.tensor([-0.9, 0.6]))
    torch.save(trainer_content(policy), tmp_path / "best_model.pth")
    with pytest.raises(DistillError, match="worse than one action for all frames, found steering"):
        distill(tmp_path / "best_model.pth", episodes, "fast", SHAPE, runs_dir=tmp_path, recipe=recipe, device="cpu")
    assert not (tmp_path / "fast").exists()


def test_a_damaged_file_of_a_phase_is_one_sentence(tmp_path):
    torch.save({"weights": torch.ones(100)}, tmp_path / "start.pt")
    (tmp_path / "start.pt").write_bytes((tmp_path / "start.pt").read_bytes()[:-200])
    with pytest.raises(TrainingError, match=r"start.pt: cannot go on from it, found \w+; remove .* to teach from the"):
        distill_module._read_phase(tmp_path / "start.pt")


def test_a_name_is_one_process(teacher, episodes, tmp_path, monkeypatch):
    def while_another_starts(work):
        with pytest.raises(RoverError, match="another process is at work in it"):
            distill(teacher, episodes, "fast", SHAPE, runs_dir=tmp_path, device="cpu")
        return SimpleNamespace(folder=tmp_path / "gone")

    monkeypatch.setattr(distill_module, "_teach", while_another_starts)
    monkeypatch.setattr(distill_module, "_leave", lambda new, *_: (new / "distill.json").touch())
    distill(teacher, episodes, "fast", SHAPE, runs_dir=tmp_path, device="cpu")


@pytest.mark.slow
def test_a_policy_that_somebody_trained_is_not_replaced_by_a_student(teacher, episodes, tmp_path):
    """The teacher's folder, as in `rover distill runs/full/best_model.pth ... --name full`, or another policy's."""
    own = tmp_path / "full" / "best_model.pth"
    own.parent.mkdir()
    shutil.copy(teacher, own)
    for checkpoint, says in ((own, "full: holds the teacher"), (teacher, "best_model.pth: is no student")):
        with pytest.raises(DistillError, match=says):
            distill(checkpoint, episodes, "full", SHAPE, runs_dir=tmp_path)
    own.rename(tmp_path / "moved.pth")
    (own.parent / "pretrained_model").mkdir()
    with pytest.raises(DistillError, match="pretrained_model: is no student, and one would replace it"):
        distill(teacher, episodes, "full", SHAPE, runs_dir=tmp_path)


def test_an_artifact_of_another_run_is_not_replaced_by_a_student(teacher, episodes, tmp_path):
    """As in `rover run best_model.pth episodes`, then `rover distill ... --name mine`."""
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "policy_static.pt").write_text("the last good policy")
    (tmp_path / "mine" / "quantize.json").write_text("{}")
    with pytest.raises(DistillError, match="mine: holds the run of another policy, which a student would replace"):
        distill(teacher, episodes, "mine", SHAPE, runs_dir=tmp_path)
    assert (tmp_path / "mine" / "policy_static.pt").read_text() == "the last good policy"


def test_what_was_killed_while_it_took_its_place_is_an_earlier_students_again(teacher, episodes, tmp_path, monkeypatch):
    """The checkpoint had moved and the run's report stayed, so the folder looked like another policy's run."""
    monkeypatch.setattr(distill_module, "_is_student", lambda path: True)
    monkeypatch.setattr(distill_module, "_teach", lambda work: SimpleNamespace(folder=tmp_path / "gone"))
    monkeypatch.setattr(distill_module, "_leave", lambda new, *_: (new / "distill.json").touch())
    for name in ("fast/quantize.json", ".fast.old/best_model.pth"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).touch()
    folder = distill(teacher, episodes, "fast", SHAPE, runs_dir=tmp_path, device="cpu")
    assert [p.name for p in tmp_path.iterdir()] == ["fast"]
    assert [p.name for p in folder.iterdir()] == ["distill.json"]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"shape": StudentShape()}, "would be its teacher"),
        ({"shape": StudentShape(54, 96), "device": "tpu"}, "device must be"),
        ({"shape": StudentShape(54, 96), "name": "../fast"}, "plain folder name"),
        ({"shape": StudentShape(54, 96), "name": ""}, "plain folder name"),
    ],
)
def test_what_cannot_be_taught_is_refused(teacher, episodes, tmp_path, options, says):
    with pytest.raises(DistillError, match=says):
        distill(teacher, episodes, **{"name": "fast", "runs_dir": tmp_path, **options})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("shape", "qat", "phases"),
    [
        (SHAPE, False, {"backbone", "transformer", "together"}),
        (SHAPE, True, {"backbone", "transformer", "together", "qat"}),
        (StudentShape(decoder_layers=1), False, {"transformer", "together"}),
        (StudentShape(), True, {"qat"}),
    ],
)
def test_steps_are_shared_by_the_phases_that_it_learns_in(shape, qat, phases):
    short = DistillRecipe.of(params(), steps=1000, phases=distill_module.phases_of(shape, qat))
    counts = {phase: getattr(short, f"{phase}_steps") for phase in DistillRecipe.PHASES}
    assert {phase for phase, steps in counts.items() if steps} == phases
    assert abs(sum(counts.values()) - 1000) <= len(phases)


def test_int8_is_held_against_what_its_teacher_would_drive(monkeypatch):
    """Both plan the same, beyond what a pulse can express; the teacher's plans are clipped, so INT8's must be too."""
    plans = np.float32([[[1.5, -0.2], [0.5, 0.1]]])
    monkeypatch.setattr(distill_module, "predictions", lambda policy, inputs: torch.from_numpy(plans))
    monkeypatch.setattr(distill_module, "ACT", lambda config, weights: None)
    ranges = {"steering": (-1.0, 1.0), "throttle": (0.0, 0.2)}
    recordings = SimpleNamespace(action_range=lambda: ranges)
    config, opened = SimpleNamespace(action_names=tuple(ranges)), SimpleNamespace(recordings=recordings)
    work, taught = SimpleNamespace(config=config, opened=opened), plans.clip((-1, 0), (1, 1))
    errors = distill_module._int8_errors(work, {}, SimpleNamespace(module=None), [], taught)
    assert len(errors) == 4 and set(errors.values()) == {0.0}
