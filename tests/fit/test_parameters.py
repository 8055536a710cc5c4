"""Parameters by name: what they write to the model, and that mistakes are named before anything is compiled."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Capsule, Hinge, Plane, SceneBuilder, Sphere
from mathota_jax.fit import Parameter, transforms
from mathota_jax.fit.parameters import parameter_vector


@pytest.fixture(scope="module")
def scene():
    builder = SceneBuilder(gravity=(0.0, 0.0, -9.81))
    builder.add_body(Plane(normal=(0, 0, 1), offset=0.0), static=True, friction=0.4, name="ground")
    builder.add_body(Box((0.1, 0.1, 0.1)), mass=2.0, friction=0.3, position=(0, 0, 1), name="cube")
    builder.add_body(Box((0.1, 0.2, 0.3)), mass=2.0, friction=0.3, position=(1, 0, 1), name="block")
    builder.add_body(Capsule(0.1, 0.2), mass=1.0, position=(2, 0, 1), name="rod")
    builder.add_joint(Hinge(parent="block", child="rod", anchor=(1.5, 0, 1), axis=(0, 1, 0), damping=0.1), name="elbow")
    return builder.build()


def written(scene, *parameters):
    """The model with the starts of the parameters in place."""
    vector = parameter_vector(*scene, parameters)
    return vector.apply(*scene, jnp.asarray(vector.start, jnp.float32))[0]


def test_mass_takes_the_inertia_along(scene):
    model = written(scene, Parameter("mass[cube]", start=3.0))
    np.testing.assert_allclose(model.mass[1], 3.0, rtol=1e-6)
    np.testing.assert_allclose(model.inertia[1], 3.0 * 2 / 3 * 0.1**2, rtol=1e-6)


def test_size_scales_lengths_and_inertia(scene):
    model = written(scene, Parameter("size[block]", start=2.0))
    np.testing.assert_allclose(model.shapes["box"]["half_extents"][1], [0.2, 0.4, 0.6], rtol=1e-6)
    np.testing.assert_allclose(model.shapes["box"]["half_extents"][0], [0.1, 0.1, 0.1], rtol=1e-6)
    np.testing.assert_allclose(model.inertia[2], 4 * scene[0].inertia[2], rtol=1e-6)
    np.testing.assert_allclose(model.size[2], 0.2, rtol=1e-6)


def test_a_dimension_sets_the_inertia_of_the_solid(scene):
    extents = np.asarray([0.2, 0.2, 0.1])
    model = written(scene, Parameter("half_extents[block]", start=extents), Parameter("mass[block]", start=5.0))
    x, y, z = extents**2
    np.testing.assert_allclose(model.inertia[2], 5.0 / 3 * np.asarray([y + z, z + x, x + y]), rtol=1e-5)


def test_inertia_scale_comes_last(scene):
    model = written(scene, Parameter("inertia_scale[cube]", start=1.5), Parameter("mass[cube]", start=4.0))
    np.testing.assert_allclose(model.inertia[1], 1.5 * 4.0 * 2 / 3 * 0.1**2, rtol=1e-6)


def test_gravity_keeps_its_direction(scene):
    np.testing.assert_allclose(written(scene, Parameter("gravity", start=9.0)).gravity, [0, 0, -9.0], rtol=1e-6)


def test_tied_parameters_are_one_number(scene):
    vector = parameter_vector(*scene, [Parameter(("friction[cube]", "friction[ground]"), start=0.7)])
    assert vector.labels == ("friction[cube] = friction[ground]",)
    model, _ = vector.apply(*scene, jnp.asarray(vector.start, jnp.float32))
    np.testing.assert_allclose(model.friction[:3], [0.7, 0.7, 0.3], rtol=1e-6)


def test_joint_leaf(scene):
    np.testing.assert_allclose(
        written(scene, Parameter("joint_damping[elbow]", start=0.4)).joint_damping, 0.4, rtol=1e-6
    )


@pytest.mark.parametrize("unbounded", [-4.0, 0.3, 5.0])
def test_any_numbers_are_consistent_moments(unbounded):
    """Triangle inequality (F. Markley and J. Crassidis, 2014): no moment is more than the sum of the others."""
    moments = np.asarray(transforms.moments().to_value(jnp.asarray([unbounded, 0.0, -unbounded])))
    assert np.all(moments > 0) and np.all(moments <= moments.sum() / 2 * (1 + 1e-6))


@pytest.mark.parametrize(
    ("transform", "value"),
    [
        (transforms.identity(), -3.0),
        (transforms.log(0.5), 0.7),
        (transforms.softplus(), 0.02),
        (transforms.softplus(1.0), 30.0),
        (transforms.logit(-1.0, 3.0), 2.5),
        (transforms.moments(), [1.0, 1.5, 2.2]),
    ],
)
def test_transforms_invert(float64, transform, value):
    np.testing.assert_allclose(transform.to_value(transform.to_unbounded(value)), value, rtol=1e-12)


def test_random_starts_keep_bounds_and_begin_with_the_given_one(scene):
    vector = parameter_vector(*scene, [Parameter("friction[cube]", 0.1, 0.5), "mass[cube]"])
    values = np.asarray(jax.vmap(vector.values)(jnp.asarray(vector.random_starts(64, seed=0))))
    np.testing.assert_allclose(values[0], [0.3, 2.0], rtol=1e-5)
    assert np.all((values[:, 0] > 0.1) & (values[:, 0] < 0.5)) and np.all(values[:, 1] > 0)
    assert np.ptp(values[:, 0]) > 0.3


@pytest.mark.parametrize(
    ("parameter", "message"),
    [
        ("frction[cube]", "unknown parameter 'frction.cube.'; known quantities: mass"),
        ("friction[cub]", "no body is called 'cub'; known: 'ground', 'cube'"),
        ("friction", "needs a body in brackets"),
        ("gravity[cube]", "without brackets"),
        ("joint_damping[knee]", "no joint is called 'knee'; known: 'elbow'"),
        ("joint_stiffness[elbow]", "built without it"),
        ("motor_gear[elbow]", "no motor is called 'elbow'; known: none"),
        ("restitution[cube]", "built without restitution"),
        ("mass[ground]", "static"),
        ("size[ground]", "a plane has no size"),
        ("radius[cube]", "not one shape with a radius"),
        (
            Parameter("friction[cube]", 0.4, 0.6),
            "start of 'friction.cube.' must lie strictly between its bounds 0.4 and 0.6",
        ),
        (Parameter("friction[cube]", 0.6, 0.4), "bounds of 'friction.cube.' must be increasing"),
        (Parameter("mass[cube]", lower=-1.0), "bounds of 'mass.cube.' must be increasing and between 0"),
        (Parameter("mass[cube]", upper=4.0, lower=1.0, transform="log"), "two bounds"),
        (Parameter("mass[cube]", start=float("nan")), "start of 'mass.cube.'"),
        (Parameter("mass[cube]", start=[1.0, 2.0]), "must have shape"),
        (Parameter("mass[cube]", transform="sqrt"), "transform of 'mass.cube.' must be one of"),
        (Parameter("inertia[block]", start=[1.0, 1.0, 3.0]), "less than the sum"),
        (Parameter(("mass[cube]", "friction[cube]")), "of one quantity"),
        (Parameter(()), "at least one name"),
        (Parameter(None), "must be a string or a tuple of them, got None"),
        (Parameter("mass[cube]", lower="a"), "bound 'lower' of 'mass.cube.' must be a number, got 'a'"),
        (Parameter("mass[cube]", start="a"), "start of 'mass.cube.' must be a number, got 'a'"),
        ("mass[²]", "no body is called '²'"),
        (7, "must be Parameter or names"),
    ],
    ids=str,
)
def test_mistakes_are_named(scene, parameter, message):
    with pytest.raises(ValueError, match=message):
        parameter_vector(*scene, [parameter])


@pytest.mark.parametrize("name", ["inertia[cube]", "half_extents[cube]"])
def test_moments_that_the_engine_does_not_tell_apart(name, scene):
    """A scene of cubes and balls knows no principal axes: a fit of a cube's sides stayed where it began."""
    builder = SceneBuilder()
    builder.add_body(Box((0.1, 0.1, 0.1)), mass=2.0, name="cube")
    builder.add_body(Sphere(0.1), mass=2.0, position=(1, 0, 0), name="ball")
    with pytest.raises(ValueError, match="equal moments"):
        parameter_vector(*builder.build(), [name])
    assert parameter_vector(*builder.build(), ["radius[ball]"]).size == 1
    assert parameter_vector(*scene, [name]).size == 3


def test_a_name_twice(scene):
    with pytest.raises(ValueError, match=r"'mass\[cube\]' is given twice"):
        parameter_vector(*scene, ["mass[cube]", "mass[cube]"])
    with pytest.raises(ValueError, match="at least one"):
        parameter_vector(*scene, [])


def test_writing_is_differentiable(scene):
    vector = parameter_vector(*scene, ["mass[block]", "half_extents[block]", "friction[cube]", "gravity"])

    def total(unbounded):
        model, _ = vector.apply(*scene, unbounded)
        return sum(jnp.sum(leaf) for leaf in jax.tree.leaves(dataclasses.replace(model, scene=None)))

    slope = jax.grad(total)(jnp.asarray(vector.start, jnp.float32))
    assert np.all(np.isfinite(slope)) and np.all(slope != 0)


def test_zero_friction_can_not_be_fitted():
    builder = SceneBuilder()
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True, friction=0.0, name="ground")
    builder.add_body(Sphere(0.1), mass=1.0, name="ball")
    with pytest.raises(ValueError, match="built without friction"):
        parameter_vector(*builder.build(), ["friction[ground]"])
