"""Worlds and states that are saved as JSON come back as they were, number by number."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrigid as dr
from diffrigid.pytree import array, pytree, static

STONE = dr.Static(dr.HeightField(heights=np.outer(np.arange(3.0), np.arange(4.0) / 7), spacing=1 / 3))


@pytree
class Wind:
    """A force that diffrigid does not have."""

    speed: jax.Array = array("D")
    side: str = static(default="west")

    def __call__(self, bodies, state, controls):
        return dr.Wrench(F=jnp.broadcast_to(self.speed[None], state.x.shape))


def plane():
    bodies = {
        "arm": dr.Body(dr.Capsule(radius=0.05, half_length=0.3), mass=1 / 3, x=(0.3, 1.0), rolling_friction=0.01),
        "tile": dr.Body(dr.Polygon(vertices=((0, 0), (1, 0), (0, 0.7))), density=np.pi, x=(2.0, 1.0), angle=0.1),
        "dot": dr.Body(None, mass=1.0, inertia=0.2, x=(5.0, 2.0)),
        "hill": dr.Static(dr.Profile(points=((-2.0, 0.0), (1 / 3, 0.1), (4.0, 0.0)))),
    }
    hinge = dr.Revolute("arm", anchor_a=(-0.3, 0.0), lower=-1.0, upper=0.1, friction=0.01)
    forces = {"push": dr.Force("dot", control="push"), "wind": Wind(speed=(0.1, 0.0))}
    return dr.scene(bodies, gravity=(0.0, -9.81), joints={"hinge": hinge}, forces=forces, ignore=[("arm", "hill")])


def space():
    bodies = {
        "die": dr.Body(dr.Box(half=(0.1, 0.2, 0.3)), mass=0.1, x=(0.5, 0.5, 2.0), w=(1.0, 2.0, 3.0)),
        "top": dr.Body(dr.Hull(vertices=((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))), density=2.0, x=(4.0, 0.0, 2.0)),
        "stone": STONE,
    }
    return dr.scene(bodies, gravity=(0.0, 0.0, -9.81), restitution_falloff=0.1, forces=[dr.Drag(linear=0.1)])


def many():
    world, state = plane()
    states = jax.tree.map(lambda leaf: jnp.stack([leaf, 2.0 * leaf], -1), state)
    return world, states


def single():
    return jax.tree.map(lambda leaf: leaf.astype(np.float32), space())


@pytest.mark.parametrize("scene", [plane, space, many, single])
def test_what_is_saved_comes_back(scene, tmp_path):
    pair = scene()
    found = dr.load_scene(dr.save_scene(tmp_path / "scene.json", *pair), kinds=(Wind,))
    assert found == pair
    assert [leaf.dtype for leaf in jax.tree.leaves(found)] == [leaf.dtype for leaf in jax.tree.leaves(pair)]
    assert jax.tree.structure(found) == jax.tree.structure(pair)


def test_a_scene_of_a_person_is_read_by_its_name(tmp_path):
    (tmp_path / "drop.toml").write_text(
        "[bodies.ball]\nshape = { disc = { radius = 0.1 } }\nmass = 2.0\nx = [0.0, 1.0]\n"
    )
    world, state = dr.load_scene(tmp_path / "drop.toml")
    assert float(dr.paths.read(world, state, "ball.mass")) == 2.0


def test_what_cannot_be_saved_or_read_is_refused(tmp_path):
    file, (world, state) = tmp_path / "scene.json", plane()
    dr.save_scene(file, world, state)
    with pytest.raises(ValueError, match="not a saved scene: no class 'Wind'.*kinds="):
        dr.load_scene(file)
    newer = json.loads(file.read_text()) | {"version": 2}
    file.write_text(json.dumps(newer))
    with pytest.raises(ValueError, match="its format is 'diffrigid scene', 2, expected 'diffrigid scene', 1"):
        dr.load_scene(file, kinds=(Wind,))
    with pytest.raises(ValueError, match="(?s)state.v is .*nan.*: expected finite"):
        dr.save_scene(file, world, dr.replace(state, v=state.v * np.nan))
    with pytest.raises(ValueError, match="state.v is of bfloat16: expected one of float16, float32, float64"):
        dr.save_scene(tmp_path / "new.json", world, dr.replace(state, v=state.v.astype("bfloat16")))
    with pytest.raises(ValueError, match="state.v is traced"):
        jax.jit(lambda v: dr.save_scene(file, world, dr.replace(state, v=v)))(state.v)
    with pytest.raises(ValueError, match=r"expected \(world, state\)"):
        dr.save_scene(file, state, world)
