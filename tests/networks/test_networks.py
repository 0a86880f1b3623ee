"""All networks: what does not depend on the order of slots, padding, sizes and files."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from agents import PretrainConfig
from agents.networks import (
    DiffuSceneConfig,
    MiDiffusionConfig,
    MixedDiffuSceneConfig,
    MixedFlux,
    MixedFluxConfig,
    MixedMiDiffusionConfig,
    build_network,
    network_config,
)
from agents.networks.flux_modules import CountConditioning, count_states, still_to_come
from agents.networks.geometry import RelationsConfig
from agents.networks.registry import config_from_state, config_state
from agents.pretraining.settings import NETWORKS
from scene_envs.errors import InvalidInputError, UnknownNameError

FEATURES, CATEGORIES, TEXT = 20, 8, 12
PROCESSES = ("continuous", "mixed")
EQUIVARIANT = ("flux", "midiffusion")
BASELINES = ("midiffusion", "diffuscene")


SEEN = [
    {"name": name}
    for name in ("observed_flags", "count_embedding", "relations", "rotation_features", "contacts", "count_logits")
]
READ: list[dict[str, Any]] = [{"name": "pooled_text"}, {"name": "count_conditioning", "largest": 9}]


def make(
    name: str, process: str, text_width: int = TEXT, zero: bool = False, attention: bool = True, **fields: Any
) -> nn.Module:
    """A small network in float64; every parameter is random unless ``zero`` keeps what starts at zero."""
    text_width = 0 if process == "continuous" else text_width
    config = network_config(
        name,
        process,
        features=FEATURES,
        categories=CATEGORIES,
        hidden=16,
        depth=2,
        heads=2,
        text_width=text_width,
        frequencies=2,
        modules=[*SEEN, *(READ if text_width else [])],
    )
    if isinstance(config, MixedFluxConfig) and not attention:
        config = config.without("contacts", "relations")
    if isinstance(config, MixedFluxConfig) and zero:
        config = config.without(*(["count_conditioning"] if text_width else []))  # begins with what a prompt asks for
    torch.manual_seed(0)
    network = build_network(replace(config, **fields)).double()
    if not zero:
        with torch.no_grad():
            for parameter in network.parameters():
                parameter.add_(0.1 * torch.randn_like(parameter))
    return network


def parameters(config: Any) -> int:
    """Number of parameters of a network."""
    return sum(parameter.numel() for parameter in build_network(config).parameters())


def inputs(process: str, slots: int, text: bool = True, batch: int = 2) -> dict[str, Any]:
    """Arguments of a network, text with padding."""
    generator = torch.Generator().manual_seed(1)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    words = {"text": normal(batch, 5, TEXT), "text_mask": torch.tensor([[True] * 3 + [False] * 2, [True] * 5])[:batch]}
    if process == "continuous":
        x = normal(batch, slots, FEATURES)
        arguments = {"x": x, "position": 0.5 * x, "noise_level": torch.tensor([0.3, 2.0]).double()[:batch]}
    else:
        arguments = {
            "pose": normal(batch, slots, 12),
            "states": torch.randint(CATEGORIES + 1, (batch, slots), generator=generator),
            "time": torch.tensor([3.0, 700.0]).double()[:batch],
            "position": normal(batch, slots, 12),
            "noise_level": torch.rand((batch, slots), generator=generator).double(),
            "observed": torch.randint(4, (batch, slots), generator=generator),
        }
    return {**arguments, **(words if text else {})}


def run(network: nn.Module, process: str, arguments: dict[str, Any]) -> Tensor:
    """What a network says, (B, N, numbers)."""
    if process == "continuous":
        arguments = {key: value for key, value in arguments.items() if not key.startswith("text")}
    if getattr(network, "count_conditioning", None) is not None and arguments["text"] is not None:
        generator = torch.Generator().manual_seed(2)
        asked = torch.randn(
            (len(arguments["text"]), network.count_conditioning.things, TEXT), generator=generator, dtype=torch.float64
        )
        arguments = {**arguments, "text": torch.cat([asked, arguments["text"]], dim=1)}
        arguments["text_mask"] = F.pad(arguments["text_mask"], (network.count_conditioning.things, 0), value=True)
    result = network(**arguments)
    return torch.cat(result, dim=-1) if process == "mixed" else result


def turned(arguments: dict[str, Any], order: Tensor, process: str) -> dict[str, Any]:
    """The same scenes with slots in another order."""
    of_slots = (
        ("x", "position") if process == "continuous" else ("pose", "states", "position", "noise_level", "observed")
    )
    return {key: value[:, order] if key in of_slots else value for key, value in arguments.items()}


def order_error(name: str, process: str, **fields: Any) -> float:
    """How much the order of slots changes."""
    network, arguments = make(name, process, **fields), inputs(process, 9)
    order = torch.tensor([4, 8, 0, 2, 7, 1, 6, 3, 5])
    straight = run(network, process, arguments)[:, order]
    other = run(network, process, turned(arguments, order, process))
    return float((other - straight).detach().abs().max())


@pytest.mark.parametrize("process", PROCESSES)
@pytest.mark.parametrize("name", EQUIVARIANT)
def test_transformers_do_not_care_about_the_order_of_slots(name: str, process: str) -> None:
    assert order_error(name, process) < 1e-9


def test_distances_do_not_care_about_the_order_of_slots() -> None:
    assert order_error("flux", "mixed", unit=(0.5, 0.4, 0.1)) < 1e-9


@pytest.mark.parametrize("process", PROCESSES)
def test_a_unet_depends_on_the_order_of_slots(process: str) -> None:
    assert order_error("diffuscene", process) > 1e-3


@pytest.mark.parametrize("process", PROCESSES)
@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("slots", [1, 2, 7, 34, 41])
def test_any_number_of_slots_goes_through(name: str, process: str, slots: int) -> None:
    said = run(make(name, process), process, inputs(process, slots))
    assert said.shape == (2, slots, FEATURES if process == "continuous" else 12 + CATEGORIES)
    assert said.isfinite().all()


@pytest.mark.parametrize("process", PROCESSES)
@pytest.mark.parametrize("name", NETWORKS)
def test_outputs_start_at_zero(name: str, process: str) -> None:
    network = make(name, process, zero=True)
    assert (run(network, process, inputs(process, 6)) == 0).all()


@pytest.mark.parametrize("process", PROCESSES)
@pytest.mark.parametrize("name", BASELINES)
def test_scenes_of_a_batch_do_not_see_each_other(name: str, process: str) -> None:
    network = make(name, process)
    alone = run(network, process, inputs(process, 6, batch=2))[:1]
    first = {key: value[:1] for key, value in inputs(process, 6, batch=2).items()}
    torch.testing.assert_close(run(network, process, first), alone, atol=1e-12, rtol=0)


@pytest.mark.parametrize("name", NETWORKS)
def test_words_matter_and_padding_does_not(name: str) -> None:
    network, arguments = make(name, "mixed"), inputs("mixed", 6)
    said = run(network, "mixed", arguments)
    padded = torch.where(arguments["text_mask"][..., None], arguments["text"], 7.0)
    torch.testing.assert_close(run(network, "mixed", {**arguments, "text": padded}), said, atol=1e-12, rtol=0)
    more = torch.cat([padded, padded.new_full((2, 3, TEXT), 9.0)], dim=1)
    mask = torch.cat([arguments["text_mask"], torch.zeros(2, 3, dtype=torch.bool)], dim=1)
    longer = run(network, "mixed", {**arguments, "text": more, "text_mask": mask})
    torch.testing.assert_close(longer, said, atol=1e-12, rtol=0)
    assert (run(network, "mixed", {**arguments, "text": arguments["text"] + 0.5}) - said).abs().max() > 1e-3


@pytest.mark.parametrize("name", BASELINES)
def test_a_row_of_padding_alone_is_no_text(name: str) -> None:
    network, arguments = make(name, "mixed"), inputs("mixed", 6)
    nothing = run(network, "mixed", {**arguments, "text": None, "text_mask": None})
    padding = {**arguments, "text_mask": torch.zeros(2, 5, dtype=torch.bool)}
    torch.testing.assert_close(run(network, "mixed", padding), nothing, atol=1e-12, rtol=0)


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("process", PROCESSES)
@pytest.mark.parametrize("name", NETWORKS)
def test_gradients_reach_every_parameter(name: str, process: str, text: bool) -> None:
    network = make(name, process, text_width=TEXT if text else 0)
    loss = run(network, process, inputs(process, 9, text)).square().sum()
    if isinstance(network, MixedFlux) and hasattr(network, "count_conditioning"):
        loss = (
            loss
            + network.count_conditioning.count_loss(
                torch.randn(2, network.count_conditioning.things, TEXT).double(), torch.zeros(2, 9).long()
            ).sum()
        )
    loss.backward()
    dead = [name for name, value in network.named_parameters() if value.grad is None or not value.grad.any()]
    assert dead == []


def test_counts_of_states_leave_filling_out() -> None:
    states = torch.tensor([[0, 3, 3, 7, 8, 8], [8, 8, 1, 1, 1, 2]])  # 7 is empty, 8 the mask
    mask = torch.tensor([[True] * 6, [False, True, False, True, True, True]])
    expected = [[1, 0, 0, 2, 0, 0, 0, 2], [0, 2, 1, 0, 0, 0, 0, 1]]
    assert count_states(states, CATEGORIES, mask).tolist() == expected


def test_what_is_asked_of_a_category_moves_the_logits_of_all_slots_alike_and_filling_does_not() -> None:
    torch.manual_seed(0)
    conditioning = CountConditioning((0, 1, 2, 3, 3, 4, 5), TEXT, 16, most=9).double()
    nn.init.normal_(conditioning.out.weight)
    states = torch.tensor([[0, 3, 3, 7, 8, 8], [8, 8, 1, 1, 1, 2]])
    asked = torch.randn(2, 7, TEXT, dtype=torch.float64)
    wanted = conditioning(states, asked)
    other = asked.clone()
    other[:, 3] += 1.0
    changed = (conditioning(states, other) - wanted).abs() > 1e-6
    assert changed.nonzero().tolist() == [[0, 3], [0, 4], [1, 3], [1, 4]]  # both are of kind 3
    filled = torch.cat([states, torch.full((2, 4), 3)], dim=1)
    mask = torch.arange(10).expand(2, -1) < 6
    torch.testing.assert_close(conditioning(filled, asked, mask), wanted)
    torch.testing.assert_close(conditioning(states.flip(1), asked), wanted)


def test_known_numbers_become_shares_of_the_masked_slots() -> None:
    """Two of category 0 and three objects in all are asked for; one of it is seen, and three slots are masked."""
    torch.manual_seed(0)
    conditioning = CountConditioning((0, 1), TEXT, 16, most=6)
    numbers = torch.full((1, 3, 7), -1e4)
    numbers[0, [0, 1, 2], [2, 1, 3]] = 0.0
    conditioning.count_logits = lambda asked: numbers  # type: ignore[method-assign]
    shares = conditioning(torch.tensor([[0, 3, 3, 3]]), torch.randn(1, 3, TEXT)).softmax(dim=-1)
    torch.testing.assert_close(shares, torch.full((1, 3), 1 / 3))
    assert float(conditioning.count_loss(torch.randn(1, 3, TEXT), torch.tensor([[0, 0, 1, 2]]))) == pytest.approx(0.0)
    assert float(still_to_come(numbers, torch.tensor([[5.0, 0.0, 3.0]]))[0, 0]) == 0.0  # more than asked: none to come


def test_more_objects_than_asked_for_do_not_bring_others() -> None:
    """The text asks for two with a probability of 0.96; 3 to 42 have 0.001 each."""
    probability = torch.tensor([0.0, 0.0, 0.96, *[0.001] * 40], dtype=torch.float64)
    visible = torch.tensor([0.0, 2.0, 3.0, 12.0, 42.0], dtype=torch.float64)
    found = still_to_come(probability.log().expand(5, -1), visible)
    number = torch.arange(43.0, dtype=torch.float64)
    beyond = torch.stack([(probability * (number - seen).clamp(min=0)).sum() for seen in visible])
    # the mean of all numbers from the visible one on, unless these are improbable
    torch.testing.assert_close(found, beyond / torch.tensor([1.0, 1.0, 0.1, 0.1, 0.1], dtype=torch.float64))
    assert bool((found.diff()[2:] < 0).all())
    assert float(found[-1]) == 0.0


@pytest.mark.parametrize("name", BASELINES)
def test_flags_and_time_are_read(name: str) -> None:
    network, arguments = make(name, "mixed"), inputs("mixed", 6)
    said = run(network, "mixed", arguments)
    for key, value in {"observed": 3 - arguments["observed"], "time": arguments["time"] + 40}.items():
        assert (run(network, "mixed", {**arguments, key: value}) - said).abs().max() > 1e-3


@pytest.mark.parametrize("name", BASELINES)
def test_fourier_features_are_off_as_published(name: str) -> None:
    network, arguments = make(name, "mixed", text_width=0), inputs("mixed", 6, text=False)
    moved = {**arguments, "position": arguments["position"] + 1, "noise_level": 2 * arguments["noise_level"]}
    assert (run(network, "mixed", moved) == run(network, "mixed", arguments)).all()


@pytest.mark.parametrize("attention", [False, True])
def test_text_that_ends_in_double_blocks_is_read_and_its_padding_is_not(attention: bool) -> None:
    network = make("flux", "mixed", text_reach="double", attention=attention)
    arguments = inputs("mixed", 7)
    said = run(network, "mixed", arguments)
    said.square().sum().backward()
    dead = [name for name, p in network.named_parameters() if p.grad is None or not p.grad.any()]
    assert all(name.startswith("count_conditioning.counts_out") for name in dead)
    padded = torch.where(arguments["text_mask"][..., None], arguments["text"], 7.0)
    torch.testing.assert_close(run(network, "mixed", {**arguments, "text": padded}), said, atol=1e-12, rtol=0)
    assert (run(network, "mixed", {**arguments, "text": arguments["text"] + 0.5}) - said).abs().max() > 1e-3
    everywhere = MixedFluxConfig(categories=8, hidden=32, text_width=16)
    assert parameters(replace(everywhere, text_reach="double")) < parameters(everywhere)


@pytest.mark.parametrize("process", PROCESSES)
@pytest.mark.parametrize("name", NETWORKS)
def test_files_give_the_same_network_back(name: str, process: str) -> None:
    network = make(name, process)
    state = json.loads(json.dumps(config_state(network.config)))  # type: ignore[arg-type]
    assert state["kind"] == name
    config = config_from_state(state, process)
    assert config == network.config
    again = build_network(config).double()
    again.load_state_dict(network.state_dict())
    arguments = inputs(process, 6)
    assert (run(again, process, arguments) == run(network, process, arguments)).all()


def test_a_network_in_a_file_says_its_kind_and_lists_become_tuples() -> None:
    fields = {"kind": "flux", "categories": 8, "unit": [1.0, 2.0, 3.0]}
    assert config_from_state(fields, "mixed") == MixedFluxConfig(8, unit=(1.0, 2.0, 3.0))
    with pytest.raises(UnknownNameError, match="network"):
        config_from_state({"categories": 8}, "mixed")


@pytest.mark.slow
def test_counts_agree_with_the_papers_size_and_with_a_sum_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.nn.Linear, "reset_parameters", lambda self: None)  # nobody draws 88 million numbers
    network = vars(PretrainConfig(network="paper").network)
    paper = {**network, **vars(network["flux"]), "modules": ()}
    del paper["flux"]
    size = network_config(process="mixed", features=33, categories=21, text_width=768, **paper)
    assert parameters(size) == pytest.approx(88.3e6, rel=2e-3)
    distance = MixedFluxConfig(categories=8, hidden=16, heads=2, single_blocks=3, modules=(RelationsConfig(),))
    plain = MixedFluxConfig(categories=8, hidden=16, heads=2, single_blocks=3)
    assert parameters(distance) > parameters(plain)
    h, inner = 16, 64
    block = (2 * h * 2 * h + 2 * 2 * h) + (4 * h * h + 4 * h) + (h * inner + inner + inner * h + h)
    around = (256 * h + h + h * h + h) + (20 * h + h + h * h + h) + (2 * h + h * h + h + h * 20 + 20)
    assert parameters(MiDiffusionConfig(features=20, hidden=h, depth=3, heads=2)) == 3 * block + around


def test_unknown_names_and_wrong_sizes_say_what_would_be_right() -> None:
    keys: dict[str, Any] = {"features": FEATURES, "categories": CATEGORIES, "hidden": 16, "depth": 2, "heads": 2}
    with pytest.raises(UnknownNameError, match="did you mean 'midiffusion'"):
        network_config("midifusion", "mixed", **keys)
    with pytest.raises(UnknownNameError, match="did you mean 'continuous'"):
        network_config("flux", "continous", **keys)
    with pytest.raises(UnknownNameError, match="did you mean 'diffuscene'"):
        config_from_state({"kind": "difuscene", "features": 20}, "continuous")
    with pytest.raises(InvalidInputError, match="network: missing a required argument: 'features'"):
        config_from_state({"kind": "midiffusion", "wings": 2}, "continuous")
    with pytest.raises(InvalidInputError, match="reads no text"):
        network_config("flux", "continuous", text_width=8, **keys)
    with pytest.raises(InvalidInputError, match="int is not the configuration of a network"):
        build_network(3)  # type: ignore[arg-type]
    for kind in (MiDiffusionConfig, DiffuSceneConfig):
        with pytest.raises(InvalidInputError, match="hidden=10 is not a multiple of heads=4"):
            kind(features=20, hidden=10, heads=4)
    with pytest.raises(InvalidInputError, match="levels=0"):
        MixedDiffuSceneConfig(categories=8, levels=0)
    with pytest.raises(InvalidInputError, match="depth=0"):
        MixedMiDiffusionConfig(categories=8, depth=0)


@pytest.mark.slow
def test_the_pages_code_and_counts_hold() -> None:
    page = (Path(__file__).parents[2] / "docs" / "networks.md").read_text()
    for code in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(code, {"__name__": "docs"})
    sizes: dict[str, Any] = {"features": 20, "categories": 8, "hidden": 192, "depth": 6, "heads": 6}
    for process, text in (("continuous", 0), ("mixed", 0), ("mixed", 128)):
        row = next(line for line in page.splitlines() if re.match(rf"\| {process} \| (width )?{text or 'none'} ", line))
        printed = [int(number.replace(",", "")) for number in re.findall(r"\d+(?:,\d+)+", row)]
        assert printed == [parameters(network_config(name, process, text_width=text, **sizes)) for name in NETWORKS]
