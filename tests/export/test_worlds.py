"""The format ``worlds``: every world is the scene that its own MJCF file is, in MuJoCo and in MuJoCo Warp."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from agents.cli import main
from agents.priors.testing import tiny_prior
from scene_envs.errors import InvalidInputError
from scene_envs.export import export, list_formats, place, worlds
from scene_envs.export.formats import resolve_formats
from scene_envs.grammars import get_grammar
from scene_envs.scene import SceneBatch
from tests.helpers.examples import load_example
from tests.helpers.export_scenes import DIMSUM, all_scenes, laid_scene

GEOMETRY = ("geom_pos", "geom_quat", "geom_size", "geom_rbound", "geom_aabb", "geom_rgba")
BODY = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_invweight0")
STEPS = 50


@pytest.fixture(scope="module")
def example() -> ModuleType:
    return load_example("worlds")


def grammar_scenes(name: str) -> SceneBatch:
    """A few scenes of a type, no two with the same objects. Those of a grammar are moved by some 0.1 mm: whether
    objects that only touch are in contact is a matter of rounding.
    """
    if name == "dimsum_table":
        return all_scenes()
    batch = get_grammar(name).sample(np.random.default_rng(0), 3)
    assert all(sorted(one) != sorted(other) for one, other in pairwise(batch.names()))
    moves = torch.randn(batch.translations.shape, generator=torch.Generator().manual_seed(0))
    return batch.with_poses(batch.translations + 1e-4 * moves, batch.rotations)


@pytest.fixture(
    scope="module",
    params=["dimsum_table"]
    + [pytest.param(name, marks=pytest.mark.slow) for name in ("restaurant_low_clutter", "living_room_shelf")]
    + [pytest.param(name, marks=pytest.mark.slow) for name in ("pantry_shelf", "breakfast_table_high_clutter")],
)
def folder(request, tmp_path_factory) -> Path:
    """An export of scenes of one type as worlds and as MJCF, moved after it was written."""
    output = tmp_path_factory.mktemp("worlds") / "written here"
    export(grammar_scenes(request.param), output, ["mjcf", "worlds"])
    return output.rename(output.with_name("read there"))


def own_models(folder: Path) -> list[tuple[Any, Any]]:
    """Model and data of each scene's own MJCF file."""
    models = [mujoco.MjModel.from_xml_path(str(path)) for path in sorted(folder.glob("scene_*/scene.xml"))]
    return [(model, mujoco.MjData(model)) for model in models]


def pairs(model: Any, data: Any, names: list[str]) -> list[tuple[str, str, int, int, float]]:
    """Contacts deeper than 1 µm as objects, numbers of their parts, and distance, sorted."""
    found = []
    for contact in data.contact:
        body = [int(model.geom_bodyid[geom]) for geom in contact.geom]
        sides = sorted((names[b], int(g - model.body_geomadr[b])) for b, g in zip(body, contact.geom, strict=True))
        found.append((sides[0][0], sides[1][0], sides[0][1], sides[1][1], float(contact.dist)))
    return sorted(contact for contact in found if contact[-1] < -1e-6)


def test_a_world_is_the_scene_of_its_own_mjcf_file(folder, example):
    path = folder / "worlds.npz"
    for world, (own, data) in enumerate(own_models(folder)):
        names = ["world", *np.load(path)["names"][world].tolist()]
        model, state = example.mujoco_world(path, world)
        assert sorted(name for name in names if name) == sorted(own.body(index).name for index in range(own.nbody))
        fields = example.world_fields(path, example.compiled(path), [world])
        for body, name in enumerate(names[1:], start=1):
            first, count = model.body_geomadr[body], model.body_geomnum[body]
            if not name:
                assert (model.geom_dataid[first : first + count] == -1).all()
                continue
            other = own.body(name).id
            start, number = own.body_geomadr[other], own.body_geomnum[other]
            assert (model.geom_dataid[first + number : first + count] == -1).all()
            for field in GEOMETRY:
                ours, theirs = getattr(model, field)[first : first + number], getattr(own, field)[start:][:number]
                np.testing.assert_array_equal(ours, theirs, err_msg=f"{name} {field}")
            shown, theirs = (m.tex(m.mat_texid[m.geom_matid[g], 1]).name for m, g in ((model, first), (own, start)))
            assert shown == theirs
            np.testing.assert_array_equal(
                model.geom_friction[first + 1 : first + number], own.geom_friction[start + 1 : start + number]
            )
            if own.body_dofnum[other]:
                for field in BODY:  # those of the file, not those that mj_setConst computes
                    np.testing.assert_allclose(
                        fields[field][0, body], getattr(own, field)[other], rtol=1e-9, atol=1e-15
                    )
                dofs, theirs = model.body_dofadr[body], own.body_dofadr[other]
                np.testing.assert_allclose(
                    fields["dof_invweight0"][0, dofs : dofs + 6], own.dof_invweight0[theirs : theirs + 6], rtol=1e-9
                )
        assert model.dof_M0.sum() == pytest.approx(own.dof_M0.sum(), rel=1e-6)
        mujoco.mj_forward(own, data)
        mujoco.mj_forward(model, state)
        theirs = pairs(own, data, [own.body(index).name for index in range(own.nbody)])
        ours = pairs(model, state, names)
        assert [contact[:-1] for contact in ours] == [contact[:-1] for contact in theirs]
        np.testing.assert_allclose([one[-1] for one in ours], [other[-1] for other in theirs], rtol=1e-9)
        mujoco.mj_step(own, data, STEPS)
        mujoco.mj_step(model, state, STEPS)
        for body, name in enumerate(names):
            if name:
                np.testing.assert_allclose(state.xpos[body], data.body(name).xpos, atol=1e-5, err_msg=name)
                np.testing.assert_allclose(state.xmat[body], data.body(name).xmat, atol=1e-4, err_msg=name)
            else:
                np.testing.assert_array_equal(state.xpos[body], 0.0)  # gravity does not move what is not there


@pytest.mark.slow
def test_worlds_of_mujoco_warp_are_the_scenes(folder, example):
    mujoco_warp = pytest.importorskip("mujoco_warp")
    path, own = folder / "worlds.npz", own_models(folder)
    m, d = example.warp_worlds(path, len(own), contacts=1500, most=2000)
    for _ in range(STEPS):
        mujoco_warp.step(m, d)
    left_out = mujoco_warp.OverflowType.NEFC | mujoco_warp.OverflowType.NARROWPHASE
    assert not (d.overflow.numpy() & left_out).any()
    found, names = d.xpos.numpy(), np.load(path)["names"]
    for world, (model, data) in enumerate(own):
        mujoco.mj_forward(model, data)
        if (data.contact.dist < -1e-4).any():
            continue  # objects that overlap fly apart, and single precision decides where
        mujoco.mj_step(model, data, STEPS)
        for body, name in enumerate(names[world], start=1):
            where = data.body(name).xpos if name else np.zeros(3)
            np.testing.assert_allclose(found[world, body], where, atol=1e-4, err_msg=name)


def test_a_model_with_a_robot_takes_the_scenes_beside_it(tmp_path, example):
    export(laid_scene(), tmp_path, "worlds")
    spec = mujoco.MjSpec.from_string(
        '<mujoco><asset><mesh name="tool" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/><texture name="wood" builtin="flat" '
        'type="2d" width="8" height="8"/><material name="red" texture="wood"/></asset><worldbody>'
        '<body name="robot" pos="0 0 3"><freejoint/><geom type="mesh" mesh="tool" material="red"/></body>'
        "</worldbody></mujoco>"
    )
    parent, child = spec.option, mujoco.MjSpec.from_file(str(tmp_path / "worlds.xml")).option
    for name in ("cone", "integrator", "impratio"):
        setattr(parent, name, getattr(child, name))
    spec.attach(
        mujoco.MjSpec.from_file(str(tmp_path / "worlds.xml")), prefix="scene/", frame=spec.worldbody.add_frame()
    )
    model, alone = spec.compile(), example.compiled(tmp_path / "worlds.npz")
    beside = example.world_fields(tmp_path / "worlds.npz", model, [0, 0], prefix="scene/")
    fields = example.world_fields(tmp_path / "worlds.npz", alone, [0, 0])
    for name, skip in {"body_pos": 2, "body_mass": 2, "geom_pos": 1, "qpos0": 7, "dof_invweight0": 6}.items():
        np.testing.assert_array_equal(beside[name][:, skip:], fields[name][:, skip - 1 if "body" in name else 0 :])
        np.testing.assert_array_equal(beside[name][1, :skip], getattr(model, name)[:skip])
    assert beside["geom_dataid"][0, 0] == 0
    meshes = [model.mesh(mesh).name for mesh in beside["geom_dataid"][0, 1:] if mesh >= 0]
    assert meshes == [f"scene/{alone.mesh(mesh).name}" for mesh in fields["geom_dataid"][0] if mesh >= 0]
    shown = {model.tex(texture).name for texture in beside["mat_texid"][0, 1:, 1] if texture >= 0}
    assert shown == {f"scene/{name}" for name in laid_scene().names()[0]}
    assert beside["mat_texid"][0, 0, 1] == model.tex("wood").id


def test_arrays_say_which_object_is_where(tmp_path):
    batch = all_scenes()
    report = export(batch, tmp_path, "worlds")
    assert [scene["worlds"] for scene in report.scenes] == [tmp_path / "worlds.npz"] * 4
    assert {path.name for path in tmp_path.iterdir()} == {"assets", "export.json", "worlds.npz", "worlds.xml"}
    assert report.size == sum(path.stat().st_size for path in tmp_path.rglob("*.*") if path.name != "export.json")
    arrays = np.load(tmp_path / "worlds.npz")
    assert (str(arrays["scene_type"]), tuple(arrays["asset_names"])) == ("dimsum_table", DIMSUM.assets)
    for scene in place(batch):
        names, slots = arrays["names"][scene.index].tolist(), arrays["slots"][scene.index].tolist()
        for item in scene.objects:
            body = 1 + names.index(item.name)
            assert (slots[body - 1], arrays["categories"][scene.index, body - 1]) == (item.slot, item.category)
            np.testing.assert_array_equal(arrays["world/body_pos"][scene.index, body], item.translation)
            np.testing.assert_array_equal(arrays["world/body_quat"][scene.index, body], item.quaternion)
            assert (body == 1) == item.welded  # the table is the only welded object
            assert arrays["world/body_mass"][scene.index, body] == (0.0 if item.welded else item.asset.mass)
        assert [name for name in names if name] == [names[row] for row, slot in enumerate(slots) if slot >= 0]
    again = tmp_path / "worlds.npz"
    before = again.read_bytes()
    export(batch, tmp_path, ["worlds", "npz"])
    with np.load(again) as after:
        assert all(np.array_equal(after[key], arrays[key]) for key in arrays)
    assert len(before) == again.stat().st_size


def test_the_shared_model_alone_has_no_contacts_and_all_hulls(tmp_path, example):
    """Libraries step it once as it is; and MuJoCo makes hulls for meshes only that geometries which collide have."""
    export(all_scenes(), tmp_path, "worlds")
    model = example.compiled(tmp_path / "worlds.npz")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.ncon == 0
    parts = [mesh for mesh in range(model.nmesh) if not model.mesh(mesh).name.endswith("_visual")]
    assert (model.mesh_graphadr[parts] >= 0).all()
    names = ["teapot", "teacup", "steamer_lid"]
    tensor = torch.zeros(3, 1, DIMSUM.features)
    tensor[..., [3, 7, 11]] = 1.0
    for scene, name in enumerate(names):
        tensor[scene, 0, 12 + DIMSUM.assets.index(name)] = 1.0
    export(SceneBatch(tensor, DIMSUM), tmp_path / "few", "worlds")
    model = example.compiled(tmp_path / "few" / "worlds.npz")  # the one body has a place for every part
    assert (model.nbody, model.ngeom) == (2, 1 + sum(len(DIMSUM.library[name].fine) for name in names))
    model, _ = example.mujoco_world(tmp_path / "few" / "worlds.npz", 2)
    assert model.body_mass[1] == DIMSUM.library["steamer_lid"].mass


def test_friction_is_that_of_the_export(tmp_path, example):
    export(laid_scene(), tmp_path, "worlds", friction=0.25)
    model, state = example.mujoco_world(tmp_path / "worlds.npz", 0)
    mujoco.mj_forward(model, state)
    assert state.ncon
    np.testing.assert_array_equal(state.contact.friction[:, :2], 0.25)


def test_a_mass_of_its_own_is_that_of_the_world(tmp_path, example):
    """Twice the mass and inertia is half the weight in a contact, and the same fall."""
    batch = laid_scene()
    export(batch, tmp_path, "worlds")
    before = np.load(tmp_path / "worlds.npz")
    files = worlds.AssetFiles(tmp_path / "assets", batch.scene_type.library.assets, 0.6, "")
    scenes = place(batch)
    for item in scenes[0].objects:
        if item.name == "teapot_0":
            vars(item).update(mass=2 * item.mass, inertia=2 * item.inertia)
    after = np.load(worlds.write_worlds(scenes, files, tmp_path))
    body = 1 + after["names"][0].tolist().index("teapot_0")
    for name, ratio in {"mass": 2.0, "subtreemass": 2.0, "inertia": 2.0, "invweight0": 0.5, "ipos": 1.0}.items():
        np.testing.assert_allclose(after[f"world/body_{name}"][0, body], ratio * before[f"world/body_{name}"][0, body])


def test_impossible_worlds_are_refused(tmp_path, monkeypatch):
    assert "worlds" in list_formats()
    assert "worlds" not in resolve_formats("all")  # those have a file for each scene
    with pytest.raises(InvalidInputError, match="worlds of 0 scenes without objects"):
        export(SceneBatch(torch.zeros(0, 3, DIMSUM.features), DIMSUM), tmp_path / "none", "worlds")
    empty = torch.zeros(2, 3, DIMSUM.features)
    empty[..., -1] = 1.0
    with pytest.raises(InvalidInputError, match="worlds of 2 scenes without objects"):
        export(SceneBatch(empty, DIMSUM), tmp_path / "empty", "worlds")
    monkeypatch.setattr(worlds, "_MOST", 500)
    with pytest.raises(InvalidInputError, match=r"4 worlds have \d+ geometries, more than 500: export fewer scenes"):
        export(all_scenes(), tmp_path / "many", "worlds")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "worlds.xml").write_text("mine")
    with pytest.raises(InvalidInputError, match=r"already holds 'worlds\.xml', which no export wrote"):
        export(laid_scene(), tmp_path / "mine", "worlds")
    assert (tmp_path / "mine" / "worlds.xml").read_text() == "mine"


def test_a_scene_without_free_objects_and_one_without_any_are_worlds(tmp_path, example):
    tensor = torch.cat(
        [SceneBatch.empty(DIMSUM, 1, 12).tensor, laid_scene().tensor, torch.zeros(1, 12, DIMSUM.features)]
    )
    tensor[2, :, -1] = 1.0
    export(SceneBatch(tensor, DIMSUM), tmp_path / "some", "worlds")
    for world, count in enumerate((1, 10, 0)):
        model, state = example.mujoco_world(tmp_path / "some" / "worlds.npz", world)
        mujoco.mj_step(model, state, 5)
        assert (np.load(tmp_path / "some" / "worlds.npz")["categories"][world] >= 0).sum() == count
    export(SceneBatch.empty(DIMSUM, 2), tmp_path / "tables", "worlds")
    model, _ = example.mujoco_world(tmp_path / "tables" / "worlds.npz", 1)
    assert (model.nv, model.nmocap) == (0, 1)


def test_the_command_writes_worlds(tmp_path, capsys):
    prior = tiny_prior(slots=6).save(tmp_path / "prior")
    words = ["count=3", "num_steps=2", "reward=null", "pictures=0", "workers=0", "export=worlds"]
    assert main(["sample", f"prior={prior}", *words, f"output={tmp_path / 'out'}"]) == 0
    found = tmp_path / "out" / "export"
    assert {path.name for path in found.iterdir()} == {"assets", "export.json", "worlds.npz", "worlds.xml"}
    assert np.load(found / "worlds.npz")["world/geom_dataid"].shape[0] == 3
    assert re.search(r"3 scenes as worlds in .*export", capsys.readouterr().out)
