"""Configuration: the same in Python and on the command line, old keys, files, sweeps."""

from __future__ import annotations

import ast
import copy
import dataclasses
import itertools
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from agents import PostTrainConfig, PretrainConfig, SearchConfig
from agents.cli import main
from agents.cli.commands import COMMANDS, load_command
from agents.cli.keys import compose, help_text, keys_of
from agents.cli.main import expand_sweeps
from agents.configuration.composition import (
    changed,
    check_same_keys,
    config_text,
    dotted_values,
    field_options,
    plain_tree,
)
from agents.planning import list_planners
from agents.planning.ledger import planner_settings
from agents.post_training.settings import MEAN_REWARDS, algorithm_settings, list_algorithms
from rewards import facts_of, list_rewards, make_reward
from scene_envs.errors import InvalidInputError, UnknownNameError

ROOT = Path(__file__).resolve().parents[2]
CONFIG_NAMES = ("Config", "Entry", "Keys", "Limits", "Names", "Planner", "Settings", "Size")
"""How the names of configuration dataclasses end."""
CONFIGS = {name: keys_of(load_command(name)) for name in COMMANDS}
SMALLEST_FIRST = sorted(CONFIGS, key=lambda name: len(dotted_values(CONFIGS[name]())))


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_defaults_are_those_of_python(command: str) -> None:
    assert compose(command, CONFIGS[command], []) == CONFIGS[command]()


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_every_key_given_with_its_default_changes_nothing(command: str) -> None:
    defaults = dotted_values(CONFIGS[command]())
    words = [f"{key}={'null' if value is None else value}" for key, value in defaults.items()
             if isinstance(value, str | int | float | None) and (value != "" or "." not in key)]  # fmt: skip
    assert compose(command, CONFIGS[command], words) == CONFIGS[command]()


def config_classes() -> dict[str, list[str]]:
    """The fields that every configuration dataclass of the packages declares itself."""
    found = {}
    for package in ("agents", "rewards", "scene_envs"):
        for file in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
                if not isinstance(node, ast.ClassDef) or not node.name.endswith(CONFIG_NAMES):
                    continue
                if any("dataclass" in ast.unparse(decorator) for decorator in node.decorator_list):
                    lines = [line for line in node.body if isinstance(line, ast.AnnAssign)]
                    own = [ast.unparse(line.target) for line in lines if "ClassVar" not in ast.unparse(line)]
                    found[f"{file.relative_to(ROOT)}: {node.name}"] = own
    return found


def test_configs_declare_a_dozen_fields_at_most() -> None:
    found = config_classes()
    assert len(found) > 60
    whole = {  # classes whose keys stand in groups, or in a JSON file
        "agents/networks/flux.py: MixedFluxConfig": 15,
        "scene_envs/assets/importing/build.py: AssetEntry": 13,
    }
    assert {name: len(own) for name, own in found.items() if len(own) > 12} == whole


@pytest.mark.parametrize("kind", [PretrainConfig, PostTrainConfig])
def test_groups_have_a_dozen_keys_at_most(kind: type) -> None:
    groups = [value for value in vars(kind()).values() if dataclasses.is_dataclass(value)]
    assert len(groups) >= 5
    assert all(len(dataclasses.fields(group)) <= 12 for group in groups)


def test_components_have_a_dozen_settings_at_most() -> None:
    kinds = [algorithm_settings(name) for name in list_algorithms()]
    kinds += [planner_settings(name) for name in list_planners()]
    assert len(kinds) >= 10
    assert {kind.__name__: len(dataclasses.fields(kind)) for kind in kinds if len(dataclasses.fields(kind)) > 12} == {}


def shown_keys(config: Any) -> set[str]:
    """Keys without the names of components; a mapping and a group inside a group are one key."""
    mappings = {field.name for field in dataclasses.fields(config) if field.metadata.get("one_key")}
    keys = {".".join(key.split(".")[: 1 if key.split(".")[0] in mappings else 2]) for key in dotted_values(config)}
    return {key for key in keys if not key.endswith(".name")}


@pytest.mark.parametrize(("kind", "most"), [(PostTrainConfig, 40), (PretrainConfig, 45)])
def test_trainings_have_a_few_dozen_keys(kind: type, most: int) -> None:
    assert len(shown_keys(kind())) + len(["adapter"]) <= most


@pytest.mark.parametrize("command", ["sample", "search", "post-train", "check-reward", "rewards"])
def test_limits_of_a_reward_are_one_mapping(command: str) -> None:
    def limits(*words: str) -> dict[str, float]:
        return vars(compose(command, CONFIGS[command], words).reward_limits)

    assert "reward_limits={timeout: 60.0, memory: 1.0}" in help_text(CONFIGS[command])
    assert limits() == {"timeout": 60.0, "memory": 1.0}
    assert (
        limits("reward_limits={timeout:120}")
        == limits("reward_limits.timeout=120")
        == {"timeout": 120.0, "memory": 1.0}
    )
    assert limits("reward_limits={memory: 2}", "reward_limits.timeout=5") == {"timeout": 5.0, "memory": 2.0}
    with pytest.raises(UnknownNameError, match=r"reward_limits\.timeot.*did you mean 'reward_limits\.timeout'"):
        limits("reward_limits={timeot: 120}")
    with pytest.raises(InvalidInputError, match=r"reward_limits\.memory=-1.0 must be a positive number"):
        limits("reward_limits.memory=-1")


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_a_paragraph_of_a_dozen_keys_at_most_for_each_part(command: str) -> None:
    paragraphs = help_text(CONFIGS[command]).split("\n\n")
    listed = []
    for paragraph in paragraphs:
        assert len(paragraphs) == 1 or re.match(r"\S.*:\n", paragraph), paragraph  # a heading
        keys = re.findall(r"^  ([\w.]+)=", paragraph, flags=re.MULTILINE)
        assert 1 <= len(keys) <= 13, paragraph  # a dozen, and adapter= beside prior=
        listed += keys
    assert sorted(set(listed) - {"adapter"}) == sorted(shown_keys(CONFIGS[command]()))
    assert len(listed) == len(set(listed))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "recipe"),
    [(PretrainConfig, "paper"), (PostTrainConfig, "demo_clutter"), (PostTrainConfig, "demo_feasible")],
)
def test_a_recipe_is_the_same_in_python(kind: Any, recipe: str) -> None:
    assert kind(recipe=recipe) == compose("x", kind, [f"recipe={recipe}"]) != kind()
    given = kind(recipe=recipe, iterations=3, optimizer={"lr": 0.5})
    assert given == compose("x", kind, [f"recipe={recipe}", "optimizer.lr=0.5", "iterations=3"])
    assert dataclasses.replace(given, seed=4) == changed(given, {"seed": 4})


@pytest.mark.parametrize(
    ("reward", "algorithm"),
    [
        ("feasible_share", "nft"),
        ("{name: weighted_sum, rewards: [feasible_share, {name: discriminator}]}", "nft"),
        ("{name: weighted_sum, rewards: [feasible_share, object_count]}", "ddpo_sf"),
        ("{name: product, rewards: [feasible_share]}", "ddpo_sf"),
        ("{name: clip, reward: stability, high: 0.9}", "nft"),
        ("feasible_objects", "ddpo_sf"),
    ],
)
def test_the_reward_chooses_the_algorithm_of_a_run_that_names_none(reward: str, algorithm: str) -> None:
    word = f"reward={reward}"
    for made in (compose("x", PostTrainConfig, [word]), PostTrainConfig(reward=yaml.safe_load(reward))):
        assert made.algorithm.name == algorithm
        assert made.optimizer.lr == made.algorithm.learning_rate
    assert compose("x", PostTrainConfig, [word, "algorithm=awm"]).algorithm.name == "awm"
    assert compose("x", PostTrainConfig, [word, "recipe=demo_clutter"]).algorithm.name == "ddpo_sf"
    assert compose("x", PostTrainConfig, [word, "algorithm.scenes_per_prompt=4"]).algorithm.name == algorithm
    assert f"algorithm={algorithm} (or" in help_text(compose("x", PostTrainConfig, [word]))


def test_rewards_of_runs_with_nft_are_means_over_objects() -> None:
    plain = {*list_rewards()} - {"clip", "product", "weighted_sum"}
    assert {name for name in plain if facts_of(make_reward(name))["averages_objects"]} == {*MEAN_REWARDS}
    assert PostTrainConfig(reward=make_reward("stability")).algorithm.name == "nft"
    with pytest.raises(UnknownNameError, match=r"key with algorithm=nft, 'algorithm\.gradient_steps'"):
        compose("x", PostTrainConfig, ["reward=stability", "algorithm.gradient_steps=2"])


@pytest.mark.slow
def test_every_option_of_a_group_composes(tmp_path: Path) -> None:
    """Each option with one command at least, and each group of a command with one option at least; registered options
    have the values that Hydra composes, as it does where there is a folder of the user's.
    """
    seen: set[tuple[str, str]] = set()
    for command in SMALLEST_FIRST:
        columns = []
        for field in dataclasses.fields(CONFIGS[command]):
            if folder := field.metadata.get("folder"):
                options = list(field_options(field))
                assert options
                new = [option for option in options if (folder, option) not in seen] or options[:1]
                columns.append([f"{field.name}={option}" for option in new])
                seen |= {(folder, option) for option in options}
        for words in itertools.zip_longest(*columns):  # an option of every group at once
            given = [word for word in words if word]
            made = compose(command, CONFIGS[command], given)
            assert isinstance(made, CONFIGS[command])
            assert made == compose(command, CONFIGS[command], given, config_dir=str(tmp_path))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PretrainConfig(network={"hiden": 3}), "did you mean 'network.hidden'"),
        (lambda: PretrainConfig(network={"hidden": "wide"}), "network.hidden=wide is not a whole number"),
        (lambda: PretrainConfig(network={"modules": {"contacts": "far"}}), "network.modules.contacts=far is not true"),
        (lambda: PretrainConfig(optimizer={"lr": "${seed}"}), r"optimizer.lr: .*'\$\{seed\}' of type 'str'"),
        (lambda: PostTrainConfig(regularisation={"scenes": "???"}), r"regularisation.scenes=\?\?\? is not a text"),
        (lambda: PostTrainConfig(guard={"limits": {"count": "few"}}), "guard.limits.count=few is not a number or null"),
        (lambda: PostTrainConfig(guard={None: 3}), "unknown key"),
        (lambda: PretrainConfig(optimizer="sgd"), "sgd"),
        (lambda: PretrainConfig(text=True), "text is a group of keys; give one of text.encoder"),
        (lambda: PostTrainConfig(rewrad="x"), "did you mean 'reward'"),
        (lambda: PostTrainConfig(guard={"action": "halt"}), "unknown action 'halt'. Known: report, rollback, stop"),
        (lambda: SearchConfig(planner={"name": "beem"}), "did you mean 'beam'"),
    ],
)
def test_wrong_values_in_python_are_named(make: Any, message: str) -> None:
    with pytest.raises((InvalidInputError, UnknownNameError), match=message):
        make()


def test_keys_of_one_config_alone_refuse_no_resume() -> None:
    """Another version may have another key; a setting of a reward is no key."""
    now = plain_tree(PostTrainConfig(reward={"name": "clip", "high": 3}))
    before = copy.deepcopy(now)
    before["old"], before["guard"]["old"], before["guard"]["limits"]["old"] = 1, 2, 3
    del before["seed"], before["algorithm"]["credit"], before["guard"]["limits"]["stack"]
    check_same_keys(Path("x"), before, now, (), PostTrainConfig)
    check_same_keys(Path("x"), now, before, (), PostTrainConfig)
    for key, value, message in [
        ("guard", {"limits": {"count": 9}}, r"\(guard.limits.count was 9, is None\)"),
        ("algorithm", {"name": "nft"}, r"\(algorithm.name was 'nft', is 'ddpo_sf'\)"),
        ("reward", {"name": "clip"}, r"\(reward.high was None, is 3\)"),
    ]:
        with pytest.raises(InvalidInputError, match=message):
            check_same_keys(Path("x"), {**before, key: value}, now, (), PostTrainConfig)
    check_same_keys(Path("x"), {**before, "algorithm": {"name": "nft"}}, now, ("algorithm",), PostTrainConfig)


def test_numbers_of_numpy_are_numbers() -> None:
    optimizer = PostTrainConfig(optimizer={"lr": np.float64(1e-4), "chunk": np.int64(4)}).optimizer
    assert (optimizer.lr, type(optimizer.chunk), optimizer.chunk) == (1e-4, int, 4)


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_a_written_config_gives_the_same_settings(command: str, tmp_path: Path) -> None:
    kind = CONFIGS[command]
    (tmp_path / "config.yaml").write_text(config_text(kind()))
    assert compose(command, kind, [], config_file=str(tmp_path / "config.yaml")) == kind()


def test_words_win_over_a_file(tmp_path: Path) -> None:
    settings = PostTrainConfig(recipe="demo_clutter", algorithm="ddpo_is", reward={"name": "clip", "high": 3})
    (tmp_path / "config.yaml").write_text(config_text(settings))
    source = str(tmp_path / "config.yaml")
    assert compose("post-train", PostTrainConfig, [], config_file=source) == settings
    words = ["algorithm=ddpo_sf", "seed=3", "reward=object_count", "optimizer.lr=0.5"]
    found = compose("post-train", PostTrainConfig, words, config_file=source)
    assert (found.algorithm.name, found.seed, found.reward, found.optimizer.lr) == ("ddpo_sf", 3, "object_count", 0.5)
    assert found.iterations == settings.iterations
    found = compose("post-train", PostTrainConfig, ["reward={name: mean, rewards: [clutter]}"], config_file=source)
    assert found.reward == {"name": "mean", "rewards": ["clutter"]}  # nothing of the reward of the file


@pytest.mark.parametrize(
    ("text", "words", "expected"),
    [
        ("algorithm: nft", [], {"name": "nft", "beta": 0.5}),
        ("algorithm: nft", ["algorithm.beta=0.3"], {"name": "nft", "beta": 0.3}),
        ("algorithm: {name: nft, beta: 0.2}", ["algorithm.draws=3"], {"name": "nft", "beta": 0.2, "draws": 3}),
        ("algorithm: {name: nft, beta: 0.2}", ["algorithm={name: ddpo_sf}"], {"name": "ddpo_sf", "gradient_steps": 8}),
        ("algorithm: {name: nft, beta: 0.2}", ["algorithm.name=ddpo_sf"], {"name": "ddpo_sf", "gradient_steps": 8}),
        ("algorithm: {name: ddpo_sf, min_std: 0.2}", ["algorithm=nft"], {"name": "nft", "beta": 0.5}),
    ],
)
def test_a_component_of_a_file_keeps_its_name_or_gives_way_to_another(
    text: str, words: list[str], expected: dict[str, Any], tmp_path: Path
) -> None:
    (tmp_path / "experiment").mkdir()
    (tmp_path / "config.yaml").write_text(text)
    (tmp_path / "experiment" / "named.yaml").write_text(f"# @package _global_\n{text}\n")
    found = [
        compose("post-train", PostTrainConfig, words, config_file=str(tmp_path / "config.yaml")),
        compose("post-train", PostTrainConfig, ["+experiment=named", *words], config_dir=str(tmp_path)),
        changed(compose("x", PostTrainConfig, ["algorithm=ddpo_is"]), {"algorithm": expected}),
    ]
    for settings in found:
        assert expected.items() <= vars(settings.algorithm).items()
    assert found[0] == found[1]
    assert found[0].algorithm == found[2].algorithm


def test_an_algorithm_beside_a_recipe_takes_nothing_of_the_recipe_s() -> None:
    """The recipe has DDPO with ``gradient_steps: 8``, which NFT does not know."""
    found = compose("post-train", PostTrainConfig, ["recipe=demo_clutter", "algorithm=nft"])
    assert (found.algorithm, found.iterations) == (PostTrainConfig(algorithm="nft").algorithm, 24)
    assert PostTrainConfig(recipe="demo_clutter", algorithm="nft") == found
    assert changed(found, {"algorithm.name": "ddpo_sf"}).algorithm == PostTrainConfig().algorithm


def test_an_option_of_a_file_is_one_of_the_group(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("network: paper")
    source = str(tmp_path / "config.yaml")
    found = compose("pretrain", PretrainConfig, ["network.depth=3"], config_file=source).network
    assert (found.hidden, found.depth) == (512, 3)
    (tmp_path / "config.yaml").write_text("network: papr")
    with pytest.raises(UnknownNameError, match="unknown network 'papr'; did you mean 'paper'"):
        compose("pretrain", PretrainConfig, [], config_file=source)


@pytest.mark.parametrize("value", ["2", "1", "0", "1.0"])
def test_a_number_is_no_boolean(value: str, tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(f"network: {{modules: {{contacts: {value}}}}}\n")
    with pytest.raises(InvalidInputError, match=f"network.modules.contacts={value} is not true or false"):
        compose("pretrain", PretrainConfig, [], config_file=str(tmp_path / "config.yaml"))
    with pytest.raises(InvalidInputError, match=f"project={value} is not true or false"):
        compose("sample", CONFIGS["sample"], [f"project={value}"])
    assert compose("sample", CONFIGS["sample"], ["project=yes"]).project is True


@pytest.mark.parametrize(
    ("words", "key", "value"),
    [
        (["seed=${iterations}"], "seed", 60),
        (["seed=0"], "seed", 0),
        (["optimizer.lr=0.25"], "optimizer.lr", 0.25),
        (["optimizer.lr=2"], "optimizer.lr", 2.0),
        (["iterations=1_000"], "iterations", 1000),
        (["iterations=${algorithm.gradient_steps}"], "iterations", 8),
        (["optimizer={lr: 0.1}", "optimizer.lr=1e-4"], "optimizer.lr", 1e-4),
        (["optimizer.lr=1e-4", "optimizer={lr: 0.1}"], "optimizer.lr", 0.1),
        (["algorithm={beta: 0.3}", "algorithm=nft"], "algorithm.beta", 0.5),
        (["algorithm=nft", "algorithm={beta: 0.3}"], "algorithm.beta", 0.3),
        (["reward={name: clip, high: 2}", "reward=clutter"], "reward", "clutter"),
        (["reward=clutter", "reward={name: clip, high: 2}"], "reward", {"name": "clip", "high": 2}),
        (["reward.averaged=true"], "reward", {"name": "object_count", "averaged": True}),
        (["prompt=${seed}: 'a', b"], "prompt", "${seed}: 'a', b"),
        (['prompt=["A cup, red: one.", "Two."]'], "prompt", ["A cup, red: one.", "Two."]),
    ],
)
def test_values_are_read_in_their_order(words: list[str], key: str, value: Any) -> None:
    settings = compose("post-train", PostTrainConfig, words)
    assert {"reward": settings.reward, **dotted_values(settings)}[key] == value


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("seed=range(1,3)", "a value cannot be read: seed=range"),
        ("reward=choice(a,b)", "a value cannot be read: reward=choice"),
        ("seed=${nothing}", "seed: Interpolation key 'nothing' not found"),
        ("seed.x=3", "seed"),
        ("+seed=3", "unknown post-train key '+seed'; did you mean 'seed'"),
        ("reward={name: [}", "a value cannot be read: reward="),
    ],
)
def test_values_that_cannot_be_read_are_named(word: str, message: str) -> None:
    with pytest.raises((InvalidInputError, UnknownNameError), match=re.escape(message)):
        compose("post-train", PostTrainConfig, [word])


def test_an_experiment_reads_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ITERATIONS", "7")
    folder = tmp_path / "a, [b] c=1"  # words of Hydra's grammar
    (folder / "experiment").mkdir(parents=True)
    (folder / "experiment" / "env.yaml").write_text(
        "# @package _global_\ndefaults: [{override /algorithm: nft}]\niterations: ${oc.env:ITERATIONS}\n"
    )
    found = compose("post-train", PostTrainConfig, ["+experiment=env"], config_dir=str(folder))
    assert (found.iterations, found.algorithm.name) == (7, "nft")


def test_cfg_job_prints_and_runs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["post-train", "optimizer.lr=1e-4", "--cfg", "job"]) == 0
    assert yaml.safe_load(capsys.readouterr().out)["optimizer"]["lr"] == 1e-4
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_multirun_has_a_folder_for_each(tmp_path: Path) -> None:
    words = ["generate", "count=2", "shard_size=2", "workers=0", "progress=none", f"output={tmp_path}"]
    assert main([*words, "--multirun", "seed=0,1"]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"seed=0", "seed=1"}
    assert yaml.safe_load((tmp_path / "seed=1" / "config.yaml").read_text())["seed"] == 1


def test_sweeps_are_every_combination() -> None:
    runs = expand_sweeps(["seed=0,1", "prompt='a, b'", "optimizer.lr=1e-4,1e-3"])
    assert [label for _, label in runs] == [
        "seed=0,optimizer.lr=0.0001", "seed=0,optimizer.lr=0.001", "seed=1,optimizer.lr=0.0001",
        "seed=1,optimizer.lr=0.001",
    ]  # fmt: skip
    assert runs[0][0][1] == "prompt='a, b'"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--config", "none.yaml"], "none.yaml: No such file"),
        (["--config-dir", "nowhere", "seed=1"], "no such folder"),
        (["--cfg", "hydra"], "only --cfg job is known"),
        (["--config"], "needs a value behind it"),
        (["+experiment=none"], "unknown experiment 'none'"),
        (["algorithm=ppo"], "unknown algorithm 'ppo'"),
        (["recipe=paper"], "recipe=paper is not for post-train"),
        (["optimizer=muon"], "unknown optimizer 'muon'. Known: adamw."),
        (["regularisation=0.5"], "give one of regularisation.objective, regularisation.weight"),
    ],
)
def test_wrong_flags_are_said(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["post-train", *words]) == 2
    assert message in capsys.readouterr().err
