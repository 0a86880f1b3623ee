"""Pretraining: exact resume, learning-rate curve, warm-up of text, and what happens when things go wrong."""

from __future__ import annotations

import copy
import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from agents.cli import main
from agents.configuration.composition import changed
from agents.configuration.composition import changed as changed_config
from agents.pretraining.initial_prior import SceneTable, build_prior, prepare
from agents.pretraining.settings import PretrainConfig
from agents.pretraining.trainer import Pretrainer, learning_rate_at, warm_up_text
from agents.priors.mixed import MixedPrior
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from agents.utils.checkpoints import derived_generator
from agents.utils.weight_average import WeightAverage
from scene_envs.datasets import generate
from scene_envs.datasets.prompts import describe_all
from scene_envs.errors import CorruptFileError, InvalidInputError, TrainingError, UnknownNameError
from scene_envs.grammars import get_grammar
from scene_envs.normalizer import Normalizer
from scene_envs.scene import SceneBatch
from tests.helpers.processes import in_processes
from tests.helpers.small_pretraining import make_run

pytestmark = pytest.mark.usefixtures("few_residual_levels")


class Killed(Exception):
    """Stands for a killed process."""


def dies_at(run: Pretrainer, step: int) -> None:
    """Let a run end before it takes ``step``."""
    update = run._update

    def dying() -> tuple[float, float]:
        if run.step == step:
            raise Killed
        return update()

    run._update = dying  # type: ignore[method-assign]


@pytest.mark.slow
def test_a_killed_run_resumes_bit_for_bit(config: PretrainConfig, raw: torch.Tensor, tmp_path: Path) -> None:
    whole = make_run(replace(config, output=str(tmp_path / "whole")), raw)
    whole.run()
    broken = make_run(config, raw)
    dies_at(broken, 5)
    (config.directory / "log.csv").write_text("step,loss\n9,7.5\n")  # of another run
    with pytest.raises(Killed):
        broken.run()
    with (config.directory / "log.csv").open("a") as file:
        file.write("5,0.")  # killed while it wrote
    resumed = make_run(config, raw)
    resumed.run()
    assert resumed.step == 6
    rows, of_whole = (list(csv.DictReader((run.directory / "log.csv").open())) for run in (resumed, whole))
    assert [row["step"] for row in rows] == [row["step"] for row in of_whole]
    assert [row["heldout"] for row in rows] == [row["heldout"] for row in of_whole]
    assert resumed.evaluations == whole.evaluations
    for name, tensor in whole.network.state_dict().items():
        assert torch.equal(tensor, resumed.network.state_dict()[name]), name
    for name, tensor in whole.average.tensors.items():
        assert torch.equal(tensor, resumed.average.tensors[name]), name


@pytest.mark.slow
def test_nan_stops_the_run_and_keeps_the_last_checkpoint(config: PretrainConfig, raw: torch.Tensor) -> None:
    run = make_run(config, raw)
    update = run._update

    def poisoned() -> tuple[float, float]:
        if run.step == 4:
            run.data = SceneTable(torch.full((8, 34, 20), float("nan")))
        return update()

    run._update = poisoned  # type: ignore[method-assign]
    with pytest.raises(TrainingError, match="nan at step 4"):
        run.run()
    assert make_run(config, raw).run().card["trained_steps"] == 6


@pytest.mark.slow
def test_a_run_does_not_go_on_with_keys_that_do_not_fit_it(config: PretrainConfig, raw: torch.Tensor) -> None:
    make_run(config, raw).run()
    for other, was in (
        ({"optimizer.name": "adamw"}, "optimizer.name was 'muon'"),
        ({"network.hidden": 32}, "network.hidden was 16"),
        ({"seed": 7}, "seed was"),
        ({"optimizer.lr": 0.5}, "optimizer.lr was"),
    ):
        with pytest.raises(InvalidInputError, match=was):
            make_run(changed(config, {"iterations": 8, **other}), raw).run()


@pytest.mark.slow
@pytest.mark.parametrize("process", ["continuous", "mixed"])
def test_a_run_that_another_network_began_is_refused_in_plain_words(
    config: PretrainConfig, raw: torch.Tensor, process: str
) -> None:
    config = replace(config, process=process)
    run = make_run(config, raw)
    run.run()
    state = torch.load(run.checkpoint_path, weights_only=True)
    name = next(iter(state["network"]))
    state["network"]["its_old_name"] = state["network"].pop(name)
    state["config"]["a_key_of_old"] = 3
    torch.save(state, run.checkpoint_path)
    with pytest.raises(InvalidInputError, match=r"cannot be resumed: 2 .* another prior.* give another output"):
        make_run(replace(config, iterations=8), raw).run()


@pytest.mark.slow
def test_a_checkpoint_that_holds_no_base_rates_resumes_bit_for_bit(
    config: PretrainConfig, raw: torch.Tensor, tmp_path: Path
) -> None:
    """The learning rate hangs on the number of the step alone, whatever the optimiser's groups say."""
    config = changed(config, {"optimizer.rate.decay": 1.0})
    whole = make_run(replace(config, output=str(tmp_path / "whole")), raw)
    whole.run()
    first = make_run(config, raw)
    save = first._save

    def stops_after_two_steps() -> None:
        save()
        raise Killed

    first._save = stops_after_two_steps  # type: ignore[method-assign]
    with pytest.raises(Killed):
        first.run()
    state = torch.load(first.checkpoint_path, weights_only=True)
    for group in state["optimizer"]["param_groups"]:
        del group["initial_lr"]
        group["lr"] = 123.0
    torch.save(state, first.checkpoint_path)
    resumed = make_run(config, raw)
    resumed.run()
    for name, tensor in whole.network.state_dict().items():
        assert torch.equal(tensor, resumed.network.state_dict()[name]), name


@pytest.mark.slow
def test_what_an_older_prior_takes_as_constant_may_not_vary_where_it_is_trained_further(
    config: PretrainConfig, raw: torch.Tensor
) -> None:
    make_run(config, raw).run()
    further = replace(config, prior=config.output)
    assert build_prior(further, raw, Normalizer.fit(raw)).config.slots == raw.shape[1]
    turned = raw.clone()
    turned[:, 1:, 3:12] = torch.tensor([0.0, -1, 0, 1, 0, 0, 0, 0, 1]) * (turned[:, 1:, -1:] == 0)
    with pytest.raises(InvalidInputError, match=r"never varied"):
        build_prior(further, turned, Normalizer.fit(turned))


def test_masks_of_empty_slots_are_those_of_the_run_also_where_an_older_prior_is_trained_further(
    config: PretrainConfig, raw: torch.Tensor
) -> None:
    fresh = build_prior(replace(config, process="mixed"), raw, Normalizer.fit(raw))
    fresh.save(Path(config.output) / "older")
    further = replace(config, prior=str(Path(config.output) / "older"), loss={"open_empty_share": 0.25})
    shares = [vars(build_prior(c, raw, Normalizer.fit(raw)).config)["open_empty_share"] for c in (config, further)]
    assert shares == [0.5, 0.25]


@pytest.mark.slow
@pytest.mark.usefixtures("few_grammar_scenes")
def test_a_prior_trained_further_reads_its_prompts_of_the_grammar() -> None:
    prior, scenes, _ = prepare(PretrainConfig(prior="dimsum_table", data="grammar"))
    assert prior.conditional
    assert all(scenes.draw(2, torch.Generator().manual_seed(0), prompts=True)[1])


def test_a_prior_trained_further_has_the_scene_type_of_its_data_and_reads_its_prompts(tmp_path: Path) -> None:
    data = generate("living_room_shelf", 4, tmp_path, workers=0, progress=False).output
    prior, scenes, _ = prepare(PretrainConfig(prior="living_room_shelf", data=str(data)))
    assert (prior.scene_type.name, prior.conditional) == ("living_room_shelf", True)
    assert all(scenes.draw(2, torch.Generator().manual_seed(0), prompts=True)[1])
    with pytest.raises(InvalidInputError, match="it has scene type 'dimsum_table', not 'living_room_shelf'"):
        prepare(PretrainConfig(prior="dimsum_table", data=str(data)))


def test_text_that_an_older_prior_does_not_read_is_refused(tmp_path: Path) -> None:
    tiny_prior("living_room_shelf", process="mixed").save(tmp_path / "older")
    with pytest.raises(InvalidInputError, match="which reads no prompts; leave text= out"):
        prepare(PretrainConfig(prior=str(tmp_path / "older"), data="grammar", text="vocabulary"))


def module_run(folder: Path, iterations: int) -> tuple[Pretrainer, MixedPrior, torch.Tensor]:
    """A run of count logits on scenes whose 1 to 8 objects are all of one of two kinds."""
    slots, kinds = torch.arange(34), 5 + torch.arange(64)[:, None] // 8 % 2
    present = (slots > 0) & (slots < 2 + torch.arange(64)[:, None] % 8)
    categories = torch.where(present, kinds, torch.where(slots == 0, 0, 7))
    at = torch.zeros(64, 34, 3), torch.eye(3).expand(64, 34, 3, 3)
    scenes = SceneBatch.from_parts(*at, categories, SceneBatch.empty("dimsum_table", 1).scene_type)
    older = tiny_prior("dimsum_table", process="mixed")
    prior = ScenePrior.load(older.save(folder / "older")).with_module("count_logits")
    assert prior.with_module("count_logits") is prior
    assert isinstance(older, MixedPrior)
    config = PretrainConfig(
        prior=str(folder / "older"), module="count_logits", output=str(folder / "run"), iterations=iterations,
        batch_size=32, optimizer={"name": "adamw", "lr": 5e-3, "ema": 0.0, "rate": {"warmup": 1}},
        logger={"checkpoint_every": 2},
    )  # fmt: skip
    x0 = prior.encode(scenes)
    return Pretrainer(config, SceneTable(x0), x0[:8], prior), older, x0


def test_count_logits_alone_learn_which_objects_belong_together(tmp_path: Path) -> None:
    """One object that is visible shows the kind of the others. No other weight changes."""
    run, older, x0 = module_run(tmp_path, 30)
    trained = run.run()
    assert isinstance(trained, MixedPrior)
    old, new = older.denoiser.state_dict(), trained.denoiser.state_dict()
    assert {name for name in new if name not in old} == {n for n in new if n.startswith("network.count_logits.")}
    assert all(torch.equal(new[name], tensor) for name, tensor in old.items())
    state = x0[[4, 12]].clone()
    state[:, 2:, 12:] = 0.0  # masked
    logits = trained.denoiser(state, 500)[1][:, 33]
    odds = logits[:, 6] - logits[:, 5]
    assert odds[0] < -2.0
    assert odds[1] > 2.0


def test_count_logits_are_trained_as_in_sampling(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No objects but the fixed ones are observed: a completion with the same visible numbers has another rest."""
    run, older, x0 = module_run(tmp_path, 3)
    assert older.config.observed_share > 0.0
    output, seen = run.prior.denoiser.output, []
    monkeypatch.setattr(run.prior.denoiser, "output", lambda *args: seen.append(args[2]) or output(*args))
    run.run()
    fixed = ~older.frame(x0).free
    states = [observed for observed in seen if len(observed.category) == 32]
    assert len(states) == 3
    assert all((observed.category == fixed).all() and (observed.pose == fixed).all() for observed in states)


def test_a_killed_run_of_a_module_resumes_bit_for_bit(tmp_path: Path) -> None:
    whole = module_run(tmp_path / "whole", 4)[0].run()
    broken = module_run(tmp_path / "broken", 4)[0]
    dies_at(broken, 3)
    with pytest.raises(Killed):
        broken.run()
    resumed = module_run(tmp_path / "broken", 4)[0].run()
    for ours, theirs in zip(resumed.denoiser.parameters(), whole.denoiser.parameters(), strict=True):
        assert torch.equal(ours, theirs)


def test_classifier_free_guidance_and_completions_leave_count_logits_out() -> None:
    """Guidance would amplify what they add, and they are trained on scenes without observed objects. Chains without a
    prompt, and under one without guidance, have them.
    """
    prior = tiny_prior("dimsum_table", process="mixed", text=True)
    x, table = prior.initial(2, 34), prior.step_table(4)
    text = prior.encode_prompts(["A scene with 3 objects."] * 2)
    completion = {"observed": prior.observed_entries(x)}
    ways: list[dict[str, Any]] = [{}, {"text": text}, {"text": text, "guidance": 1.0}, completion]
    before = [prior.transition(x, 0, table, **how).probs for how in ways]
    prior = prior.with_module("count_logits")
    torch.nn.init.normal_(prior.denoiser.network.count_logits.layers[-1].weight)
    after = [prior.transition(x, 0, table, **how).probs for how in ways]
    assert [torch.equal(*pair) for pair in zip(before, after, strict=True)] == [False, False, True, True]


def test_a_module_is_trained_in_a_prior_that_can_have_it(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="module=count_logits is trained alone, so it needs a trained prior"):
        prepare(PretrainConfig(module="count_logits", data="grammar"))
    with pytest.raises(InvalidInputError, match="count_logits needs a mixed flux network"):
        tiny_prior("dimsum_table").with_module("count_logits")
    with pytest.raises(UnknownNameError, match="count_logits"):
        PretrainConfig(module="contacts")


@pytest.mark.slow
def test_a_truncated_checkpoint_is_named(config: PretrainConfig, raw: torch.Tensor) -> None:
    run = make_run(config, raw)
    run.run()
    run.checkpoint_path.write_bytes(run.checkpoint_path.read_bytes()[:500])
    with pytest.raises(CorruptFileError, match=r"checkpoint\.pt"):
        make_run(replace(config, iterations=8), raw).run()


def test_learning_rate_warms_up_and_ends_at_its_floor() -> None:
    config = PretrainConfig(iterations=1000, optimizer={"lr": 1.0, "rate": {"warmup": 10, "final": 0.1, "decay": 1.0}})
    assert learning_rate_at(0, config) == pytest.approx(0.1)
    assert learning_rate_at(9, config) == pytest.approx(1.0)
    assert learning_rate_at(505, config) == pytest.approx(0.55)
    assert learning_rate_at(1000, config) == pytest.approx(0.1)


def test_learning_rate_stays_at_its_peak_until_the_decay_begins() -> None:
    config = PretrainConfig(iterations=1000, optimizer={"lr": 1.0, "rate": {"warmup": 10, "final": 0.1, "decay": 0.2}})
    assert {learning_rate_at(step, config) for step in range(9, 801)} == {1.0}
    assert learning_rate_at(900, config) == pytest.approx(0.55)  # half way along the cosine
    assert learning_rate_at(1000, config) == pytest.approx(0.1)
    assert learning_rate_at(900, changed(config, {"optimizer.rate.final": 1.0})) == 1.0
    late = changed(config, {"optimizer.rate.warmup": 900})  # a decay never begins in the warm-up
    assert learning_rate_at(899, late) == 1.0
    assert learning_rate_at(950, late) == pytest.approx(0.55)


def test_a_decay_share_that_is_none_is_refused(config: PretrainConfig, raw: torch.Tensor) -> None:
    with pytest.raises(InvalidInputError, match=r"decay=1\.5 is outside 0\.\.1"):
        make_run(changed(config, {"optimizer.rate.decay": 1.5}), raw)


def test_the_weight_average_follows_its_closed_form() -> None:
    layer = torch.nn.Linear(1, 1, bias=False)
    average = WeightAverage(layer, decay=0.5)
    start = average.tensors["weight"].clone()
    with torch.no_grad():
        layer.weight.add_(1.0)
    used = [average.update(layer) for _ in range(3)]
    kept = torch.tensor(used).prod()
    torch.testing.assert_close(average.tensors["weight"], kept * start + (1 - kept) * layer.weight.detach())


@pytest.mark.parametrize("process", ["continuous", "mixed"])
def test_parts_one_after_the_other_add_up_to_their_batch(
    config: PretrainConfig, raw: torch.Tensor, process: str
) -> None:
    """The gradient of a step is the mean over its parts, each with noise of its own."""
    run = make_run(changed(config, {"process.name": process, "optimizer.compute.accumulate": 2}), raw)
    losses = [run._part_loss(4, derived_generator(0, 0, part)) for part in range(2)]
    expected = torch.autograd.grad(sum(losses) / 2, list(run.network.parameters()), allow_unused=True)  # type: ignore[arg-type]
    norm = torch.stack([g.norm() for g in expected if g is not None]).norm()
    value, found = run._update()
    assert value == pytest.approx(sum(float(loss.detach()) for loss in losses) / 2, rel=1e-5)
    assert found == pytest.approx(float(norm), rel=1e-4)


def test_a_batch_that_cannot_be_parted_is_refused(config: PretrainConfig, raw: torch.Tensor) -> None:
    with pytest.raises(InvalidInputError, match="not a multiple of 3"):
        make_run(changed(config, {"optimizer.compute.accumulate": 3}), raw)
    with pytest.raises(UnknownNameError, match="did you mean 'bfloat16'"):
        make_run(changed(config, {"optimizer.compute.precision": "bfloat"}), raw)


@pytest.mark.slow
def test_autocast_is_of_the_network_only(config: PretrainConfig, raw: torch.Tensor) -> None:
    run = make_run(changed(config, {"optimizer.compute.precision": "bfloat16"}), raw)
    x = run.prior.initial(2, 34)
    pose, logits = run.prior.denoiser(x, torch.tensor([5, 900]))
    assert (pose.dtype, logits.dtype) == (torch.float32, torch.float32)
    assert run.run().denoiser.precision == torch.float32


@pytest.mark.slow
@pytest.mark.usefixtures("few_grammar_scenes")
def test_a_grammar_without_end_trains_a_prior_that_reads_prompts(tmp_path: Path) -> None:
    config = PretrainConfig(
        output=str(tmp_path), data="grammar", text="vocabulary", iterations=2, batch_size=4,
        network={"hidden": 16, "depth": 1, "heads": 2},
        logger={"log_every": 1, "evaluate_every": 2, "checkpoint_every": 2},
    )  # fmt: skip
    prior, data, heldout = prepare(config)
    assert data.size == 0
    first, again = (data.draw(3, torch.Generator().manual_seed(1), prompts=True) for _ in range(2))
    assert torch.equal(first[0], again[0])
    assert first[1] == again[1]
    assert all(len(group) == 3 for group in first[1])
    trained = Pretrainer(config, data, heldout[:8], prior).run()
    assert trained.conditional
    assert trained.card["training_scenes"] == 8


def ends_as_main(words: list[str]) -> None:
    raise SystemExit(main(words))


@pytest.mark.slow
def test_two_processes_take_the_steps_of_one_with_twice_the_parts(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    generate("dimsum_table", 16, tmp_path / "data", workers=0, verify=False, progress=False)
    keys = ["iterations=3", "batch_size=8", "network.hidden=16", "network.depth=1", "network.heads=2", "seed=3"]
    keys += ["optimizer.rate.warmup=2", "logger.log_every=1"]
    data = [f"data={tmp_path / 'data'}", f"heldout={tmp_path / 'data'}"]
    assert in_processes(ends_as_main, ["pretrain", *data, *keys, f"output={tmp_path / 'two'}"]) == [0, 0]
    assert capfd.readouterr().out.count("held-out loss") == 1  # the first process alone speaks
    assert main(["pretrain", *data, *keys, "optimizer.compute.accumulate=2", f"output={tmp_path / 'one'}"]) == 0
    for name in ("two", "one"):
        assert {"config.yaml", "metrics.json", "prior"} <= {path.name for path in (tmp_path / name).iterdir()}
    two, one = (list(csv.DictReader((tmp_path / name / "log.csv").open())) for name in ("two", "one"))
    assert len(two) == len(one) == 3
    for first, second in zip(two, one, strict=True):
        assert float(first["loss"]) == pytest.approx(float(second["loss"]), rel=1e-4)
        assert float(first["gradient_norm"]) == pytest.approx(float(second["gradient_norm"]), rel=1e-3)
    assert float(two[-1]["heldout"]) == pytest.approx(float(one[-1]["heldout"]), rel=1e-4)


@pytest.mark.slow
def test_one_prior_is_trained_on_several_scene_types(tmp_path: Path) -> None:
    for scene in ("dimsum_table", "pantry_shelf"):
        generate(scene, 12, tmp_path / scene, workers=0, verify=False, progress=False)
    config = PretrainConfig(
        output=str(tmp_path / "run"), data=f"{tmp_path / 'dimsum_table'},{tmp_path / 'pantry_shelf'}",
        text="vocabulary",
        iterations=2, batch_size=8, network={"hidden": 16, "depth": 1, "heads": 2},
        logger={"log_every": 1, "evaluate_every": 2},
    )  # fmt: skip
    prior, data, heldout = prepare(config)
    assert prior.scene_type.name == "dimsum_table+pantry_shelf"
    scenes, prompts = data.draw(150, torch.Generator().manual_seed(0), prompts=True)
    tables = prior.decode(scenes).categories == prior.scene_type.assets.index("cafe_table")
    assert float(tables.any(dim=1).float().mean()) == pytest.approx(0.5, abs=0.12)
    assert len(prompts) == 150
    trained = Pretrainer(config, data, heldout if len(heldout) else scenes[:4], prior).run()
    assert trained.sample(2, prompt="A scene with 9 objects.", num_steps=2).tensor.shape[1] == 61


def test_averages_of_a_checkpoint_go_to_the_device_of_the_present_ones() -> None:
    saved = WeightAverage(torch.nn.Linear(2, 1), decay=0.5)
    average = WeightAverage(torch.nn.Linear(2, 1, device="meta"), decay=0.5)
    average.restore(saved.tensors, updates=3)
    assert {tensor.device.type for tensor in average.tensors.values()} == {"meta"}
    assert average.updates == 3


@pytest.mark.slow
def test_a_gradient_that_is_not_finite_is_not_applied(config: PretrainConfig, raw: torch.Tensor) -> None:
    run = make_run(config, raw)
    clip = torch.nn.utils.clip_grad_norm_

    def poisoned(parameters: Any, *arguments: Any) -> torch.Tensor:
        parameters = list(parameters)
        if run.step == 3:
            parameters[0].grad.fill_(torch.nan)
        return clip(parameters, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.nn.utils, "clip_grad_norm_", poisoned)
        with pytest.raises(TrainingError, match=r"the gradient norm became nan at step 3.*give another output"):
            run.run()
    assert all(bool(tensor.isfinite().all()) for tensor in run.network.state_dict().values())
    assert make_run(config, raw).run().card["trained_steps"] == 6


@pytest.mark.slow
def test_a_run_does_not_go_on_with_other_data(config: PretrainConfig, raw: torch.Tensor) -> None:
    make_run(replace(config, iterations=2), raw).run()
    others = raw.clone()
    others[:, 1:, 0] += 0.2
    with pytest.raises(InvalidInputError, match="was started with other scenes"):
        make_run(config, others).run()
    with pytest.raises(InvalidInputError, match="was started with other scenes"):
        make_run(config, raw[:60]).run()
    assert make_run(config, raw).run().card["trained_steps"] == 6


@pytest.mark.slow
def test_a_prior_trained_further_keeps_its_origin_and_licence(config: PretrainConfig, raw: torch.Tensor) -> None:
    older = tiny_prior()
    older.card = {
        "imported_from": "authors.ckpt", "license": "CC BY-NC", "trained_steps": 100_000, "measures": {"scenes": 2.0},
        "limits": "None.",
    }  # fmt: skip
    path = older.save(config.directory / "older")
    run = replace(config, prior=str(path), output=str(config.directory / "run"), iterations=1)
    prior = ScenePrior.load(path)
    scenes = prior.encode(SceneBatch(raw, prior.scene_type))
    card = Pretrainer(run, SceneTable(scenes[:56]), scenes[56:], prior).run().card
    assert card["license"] == "CC BY-NC"
    assert card["imported_from"] == "authors.ckpt"
    assert card["base"] == {"name": "older", "trained_steps": 100_000}
    assert card["trained_steps"] == 1
    assert not {"measures", "limits"} & card.keys()


def test_the_error_that_is_left_is_measured_on_scenes_of_every_part(
    config: PretrainConfig, raw: torch.Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run(replace(config, iterations=0), raw)
    monkeypatch.setattr("agents.pretraining.trainer._RESIDUAL", 3)
    seen: list[torch.Tensor] = []
    monkeypatch.setattr(type(run.prior), "fit_residual", lambda self, x0: seen.append(x0))
    run.run()
    assert torch.equal(seen[0], run.heldout_data[[0, 3, 7]])


@pytest.mark.slow
def test_datasets_of_another_scene_type_are_named(tmp_path: Path) -> None:
    for scene in ("dimsum_table", "pantry_shelf"):
        generate(scene, 4, tmp_path / scene, workers=0, verify=False, progress=False)
    dimsum, pantry = str(tmp_path / "dimsum_table"), str(tmp_path / "pantry_shelf")
    with pytest.raises(InvalidInputError, match=r"holds scenes of 'pantry_shelf', and scene=dimsum_table"):
        prepare(PretrainConfig(data=pantry))
    with pytest.raises(InvalidInputError, match=r"heldout=.* holds scenes of 'pantry_shelf'"):
        prepare(PretrainConfig(data=dimsum, heldout=pantry))


@pytest.mark.slow
def test_a_run_of_no_steps_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    generate("dimsum_table", 4, tmp_path / "data", workers=0, verify=False, progress=False)
    small = ["network.hidden=16", "network.depth=1", "network.heads=1", "iterations=0"]
    assert main(["pretrain", f"data={tmp_path / 'data'}", *small, f"output={tmp_path / 'run'}"]) == 0
    assert "0 steps" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("keys", "told"),
    [
        ({"process": {"noise": {"ceiling": float("inf")}}}, "ceiling=inf must be a positive number"),
        ({"loss": {"noise": {"mean": 500.0}}}, "lie outside the schedule"),
    ],
)
def test_noise_levels_outside_the_schedule_are_refused(
    config: PretrainConfig, raw: torch.Tensor, keys: dict[str, Any], told: str
) -> None:
    with pytest.raises(InvalidInputError, match=told):
        make_run(PretrainConfig(output=config.output, network=config.network, iterations=1, **keys), raw)._update()


def fresh(count: int = 24, **keys: object) -> tuple[MixedPrior, SceneTable]:
    """A prior without training, and ``count`` scenes with prompts."""
    scenes = get_grammar("living_room_shelf").sample(np.random.default_rng(0), count)
    prompts = describe_all(scenes, np.random.default_rng(0))
    text = {"encoder": "vocabulary", "vocabulary": {"width": 48, "depth": 1, "latents": 2}}
    small = PretrainConfig(scene="living_room_shelf", text=text, network={"hidden": 32, "depth": 2, "heads": 2})
    config = changed_config(small, keys)
    prior = build_prior(config, scenes.tensor, Normalizer.fit(scenes.tensor), prompts)
    assert isinstance(prior, MixedPrior)
    return prior, SceneTable(prior.encode(scenes), prompts)


def read_numbers(prior: MixedPrior, prompt: str) -> torch.Tensor:
    """The likeliest number of each kind of object, and of all objects."""
    conditioning = prior.denoiser.network.count_conditioning
    with torch.no_grad():
        return conditioning.count_logits(prior.encode_prompts([prompt])[0][:, : conditioning.things]).argmax(dim=-1)[0]  # type: ignore[no-any-return]


@pytest.mark.slow
def test_numbers_of_objects_are_read_from_prompts() -> None:
    prior, data = fresh(count=96)
    assert warm_up_text(prior, data, 250, 8, seed=0) is not None
    assert [int(read_numbers(prior, f"A scene with {n} objects.")[-1]) for n in (4, 6, 8)] == [4, 6, 8]
    kinds = list(dict.fromkeys(asset.display_name for asset in prior.scene_type.library))
    games = [
        int(read_numbers(prior, f"A scene with {what}.")[kinds.index("board game")])
        for what in ("a board game", "two board games")
    ]
    assert games == [1, 2]


def test_assets_of_one_name_are_one_kind_to_a_prompt() -> None:
    prior, _ = fresh()
    names = [asset.display_name for asset in prior.scene_type.library]
    assert len(set(names)) < len(names)
    assert prior.denoiser.network.count_conditioning.things == len(set(names)) + 1


def test_the_same_seed_learns_the_same_and_nothing_else_changes() -> None:
    prior, data = fresh()
    priors = [prior, copy.deepcopy(prior)]
    before = {name: value.clone() for name, value in priors[0].denoiser.state_dict().items()}
    for prior in priors:
        warm_up_text(prior, data, 3, 16, seed=5)
    states = [prior.denoiser.state_dict() for prior in priors]
    changed = {name for name in before if not torch.equal(states[0][name], before[name])}
    assert all(torch.equal(states[0][name], states[1][name]) for name in before)
    assert changed
    assert all(name.startswith(("text_encoder.", "network.count_conditioning.counts_out.")) for name in changed)


@pytest.mark.parametrize(
    "keys",
    [{"text.vocabulary.count_conditioning": False}, {"network.name": "midiffusion", "process.empty_slots": "attended"}],
)
def test_a_network_without_count_conditioning_has_nothing_to_learn(keys: dict[str, object]) -> None:
    prior, data = fresh(**keys)
    assert warm_up_text(prior, data, 3, 16, seed=0) is None
