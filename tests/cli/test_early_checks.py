"""Refusal of wrong values before torch is imported."""

from __future__ import annotations

import ast
import subprocess
import sys

import pytest

from agents.cli import main
from agents.configuration.composition import MEASURE_NAMES, known_masks, known_rewards
from agents.pretraining.settings import NETWORKS, registered_networks
from agents.priors import list_priors
from rewards import list_rewards
from rewards.registry import registered_module
from scene_envs import list_masks
from scene_envs.grammars import list_grammars

LINES = {
    "view scene=[1,2]": "give the name of one scene type",
    "generate scene={a:b}": "give the name of one scene type",
    "evaluate data=,": "names no dataset",
    f"sample guidance={'9' * 400}": "guidance=",
    f"pretrain loss.noise.mean={'9' * 400}": "mean=",
    "evaluate workers=-1": "workers=-1: give a number of processes",
    "evaluate prior=dimsum_tabel": "did you mean 'dimsum_table'",
    "evaluate prior=runs/nowhere": "'runs/nowhere' holds no prior",
    "evaluate measures=layuot": "did you mean 'layout'",
    "evaluate measures=3": "measures=3 is no list of names",
    "evaluate data=nowhere": "data='nowhere': nothing is at 'nowhere'",
    "evaluate prompt_count=1": "prompt_count=1 must be from 2 to count=200",
    "evaluate count=0": "an evaluation needs count >= 2",
    "evaluate guidance=nan": "guidance=nan must be a finite number",
    "doctor reward=object_cuont": "did you mean 'object_count'",
    "doctor regularisation.scenes=nowhere": "regularisation.scenes='nowhere': nothing is at 'nowhere'",
    "doctor algorithm.credit=objects": "did you mean 'object'",
    "generate progress=bars": "did you mean 'bar'",
    "doctor slots=0": "slots=0 must be at least 1",
    "post-train device=cuad": "device='cuad' is no torch device",
    "post-train optimizer.lr=nan": "lr=nan must be positive",
    "search objective=object_cuont": "did you mean 'object_count'",
    "search scenes=nowhere": "no scene file, run or dataset is there",
    "search planner=baem": "did you mean 'beam'",
    "search planner=gradient planner.planner=baem": "did you mean 'beam'",
    "search mask=culprit": "did you mean 'culprits'",
    "search mask={name:culprit,at_least:2}": "did you mean 'culprits'",
    "post-train reward={name:clpi,reward:object_count,high:3}": "did you mean 'clip'",
    "search adapter=nowhere prior=dimsum_table": "unknown prior 'nowhere'",
    "demo workers=-3": "workers=-3: give a number of processes",
    "generate count=0": "count=0 must be at least 1",
    "generate shard_size=0": "shard_size=0 must be at least 1",
    "generate scene=dimsum_tabel": "did you mean 'dimsum_table'",
    "generate backend=rya": "did you mean 'ray'",
    "sample count=0": "count=0 must be at least 1",
    "sample num_steps=-5": "num_steps=-5 must be at least 1",
    "sample batch_size=0": "batch_size=0 must be at least 1",
    "sample slots=0": "slots=0 must be at least 1, or null",
    "sample eta=nan": "eta=nan must be at least 0",
    "sample reward_timeout=0": "reward_timeout=0.0 must be more than 0",
    "sample guidance=2": "guidance=2 strengthens a prompt",
    "sample claim_guidance=2": "claim_guidance=2 guides scenes to the claims of a prompt",
    "search claim_guidance=2": "give prompt=, or leave claim_guidance=0",
    "rearrange prior=dimsum_table claim_guidance=-1": "claim_guidance=-1.0 must be a finite number",
    "evaluate claim_guidance=nan": "claim_guidance=nan must be a finite number",
    "sample physics_guidance=2": "physics_guidance=2.0 must be a number from 0 to 1",
    "search physics_guidance=-1": "physics_guidance=-1.0 must be a number from 0 to 1",
    "complete prior=dimsum_table physics_guidance=nan": "physics_guidance=nan must be a number from 0 to 1",
    "evaluate physics_guidance=1.1": "physics_guidance=1.1 must be a number from 0 to 1",
    "export prior=dimsum_table physics_guidance=2": "physics_guidance=2.0 must be a number from 0 to 1",
    "view prior=dimsum_table physics_guidance=-1": "physics_guidance=-1.0 must be a number from 0 to 1",
    "sample union=one": "did you mean 'one_type'",
    "sample export=drkae": "did you mean 'drake'",
    "complete": "name a scene file, run or dataset",
    "complete scenes=nowhere": "no scene file, run or dataset is there",
    "complete scenes=nowhere prior=dimsum_table": "no scene file, run or dataset is there",
    "rearrange prior=dimsum_table count=0": "count=0 must be at least 1, or null",
    "complete prior=dimsum_table fill=-1": "fill=-1 must be at least 0",
    "project": "name a scene file, run or dataset",
    "project scenes=nowhere": "no scene file, run or dataset is there",
    "export scenes=nowhere": "no scene file, run or dataset is there",
    "export prior=dimsum_table formats=drkae": "did you mean 'drake'",
    "export prior=dimsum_table friction=-1": "friction=-1.0 must be at least 0",
    "export": "name either a scene file, run or dataset",
    "view": "say what to show",
    "view scene=dimsum_table first=-1": "first=-1 must be at least 0",
    "view scene=dimsum_tabel": "did you mean 'dimsum_table'",
    "pretrain data=nowhere": "data='nowhere': nothing is at 'nowhere'",
    "pretrain data=grammar scene=dimsum_tabel": "did you mean 'dimsum_table'",
    "pretrain process.schedule=karas": "did you mean 'karras'",
    "pretrain loss.observed_share=2": "observed_share=2.0 is outside 0..1",
    "package-prior prior=dimsum_table output=x precision=float12": "unknown precision 'float12'",
    "import-checkpoint a.ckpt metadata.json": "'a.ckpt' is no file",
    "check-reward scene=dimsum_tabel": "did you mean 'dimsum_table'",
    "priors prior=dimsum_tabel": "did you mean 'dimsum_table'",
}


@pytest.mark.slow
def test_names_paths_and_numbers_are_refused_without_torch():
    code = (
        "import sys\nfrom agents.cli import main\n"
        f"for line in {list(LINES)!r}:\n"
        "    assert main(line.split()) == 2, line\n    assert 'torch' not in sys.modules, line"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for line, told in zip(LINES.values(), done.stderr.splitlines(), strict=True):
        assert line in told


def test_the_names_that_are_known_without_torch_are_those_of_the_packages():
    own = {name for name in list_rewards() if (registered_module(name) or "").startswith("rewards.")}
    assert len(own) > 15
    assert len(list_priors()) > 8
    code = (
        "from agents.configuration.composition import known_masks, known_rewards, known_scenes\n"
        "print([known_masks(), known_rewards(), known_scenes()])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    masks, rewards, scenes = ast.literal_eval(done.stdout)
    assert own <= set(rewards) <= set(list_rewards()) == set(known_rewards())
    assert set(masks) <= set(list_masks()) == set(known_masks())
    assert {"culprits", "explicit", "region"} <= set(masks)
    assert set(scenes) <= set(list_grammars())
    assert set(NETWORKS) <= set(registered_networks())


def test_words_of_groups_are_those_of_the_parts_they_are_for():
    from agents.diffusion.categorical import CATEGORICAL_KERNELS, UNMASKINGS
    from agents.diffusion.gaussian import _SCHEDULES, LOSS_WEIGHTINGS, PREDICTIONS, TIMESTEP_DISTRIBUTIONS
    from agents.evaluation.measure import MEASURES
    from agents.networks.denoisers import EMPTY_SLOTS
    from agents.networks.flux import TEXT_REACHES
    from agents.pretraining.initial_prior import MOMENTS
    from agents.pretraining.settings import FluxSettings, LossSettings, ProcessSettings
    from agents.priors.config import PROCESSES
    from agents.priors.continuous import ROTATION_WIDTHS
    from agents.priors.mixed import CATEGORY_LOSSES

    assert tuple(MEASURES) == MEASURE_NAMES
    for make, key, known in (
        (ProcessSettings, "name", PROCESSES),
        (ProcessSettings, "prediction", PREDICTIONS),
        (ProcessSettings, "schedule", _SCHEDULES),
        (ProcessSettings, "moments", MOMENTS),
        (ProcessSettings, "rotation", ROTATION_WIDTHS),
        (ProcessSettings, "kernel", CATEGORICAL_KERNELS),
        (ProcessSettings, "empty_slots", EMPTY_SLOTS),
        (ProcessSettings, "unmasking", UNMASKINGS),
        (LossSettings, "timesteps", TIMESTEP_DISTRIBUTIONS),
        (LossSettings, "weighting", LOSS_WEIGHTINGS),
        (LossSettings, "category", CATEGORY_LOSSES),
        (FluxSettings, "text_reach", TEXT_REACHES),
    ):
        for word in known:
            assert getattr(make(**{key: word}), key) == word


@pytest.mark.parametrize("word", ["output=\udcff", "prior=\udcff", "title=\udcff\n", "output=a\0b", "\ud800=1"])
def test_words_that_are_no_text_are_refused(word, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["sample", word]) == 2
    assert "is no text in UTF-8" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
