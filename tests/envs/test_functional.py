"""The functional environments: random starts, pure steps, time limit, derivatives, bad input."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mathota_envs
from mathota_envs import ENVIRONMENTS, EnvState, make
from mathota_envs.worlds import start_world, start_worlds, step_world, step_worlds
from tests.marks import slow_but

EVERY_ID = pytest.mark.parametrize("id", ENVIRONMENTS)


def action_of(environment, fraction=0.3):
    return jnp.asarray(environment.action_space.high) * fraction


def keys(count, seed=0):
    return jax.random.split(jax.random.key(seed), count)


@EVERY_ID
def test_spaces_describe_what_reset_and_step_return(id):
    environment = make(id)
    world = start_world(environment, jax.random.key(0))
    env_state, transition = step_world(environment, world.env_state, action_of(environment))
    for observation in (world.observation, transition.observation):
        assert np.asarray(observation) in environment.observation_space
    assert transition.reward.shape == transition.terminated.shape == transition.truncated.shape == ()
    assert transition.terminated.dtype == transition.truncated.dtype == bool
    assert int(env_state.step_count) == 1
    assert jax.tree.structure(env_state) == jax.tree.structure(world.env_state)
    assert environment.metadata["render_fps"] == round(1 / environment.dt)


@EVERY_ID
def test_starts_follow_from_the_key_and_differ_between_keys(id):
    environment = make(id)
    worlds = start_worlds(environment, keys(6))
    observations = np.asarray(worlds.observation)
    assert len(np.unique(observations, axis=0)) == 6
    np.testing.assert_array_equal(observations, start_worlds(environment, keys(6)).observation)
    restarted = np.asarray(start_worlds(environment, worlds.key).observation)
    assert not (restarted == observations).all(axis=1).any(), "the second episode must start elsewhere"


@pytest.mark.slow
@pytest.mark.parametrize("id", ENVIRONMENTS)
def test_a_batch_agrees_with_single_worlds(id):
    environment = make(id)
    batch = start_worlds(environment, keys(3))
    singles = [start_world(environment, key) for key in keys(3)]
    actions = jnp.linspace(-0.5, 0.5, 3)[:, None] * environment.action_space.high
    for _ in range(5):
        batch, transitions = step_worlds(environment, batch, actions)
        for index in range(3):
            env_state, transition = step_world(environment, singles[index].env_state, actions[index])
            singles[index] = singles[index]._replace(env_state=env_state)
            # The same arithmetic, fused differently: float32 round-off only.
            np.testing.assert_allclose(transitions.observation[index], transition.observation, rtol=1e-4, atol=2e-5)


@EVERY_ID
def test_equal_options_share_one_compilation(id):
    assert make(id) == make(id) and hash(make(id)) == hash(make(id))
    assert make(id) != make(id, max_episode_steps=7)
    assert len({make(id), make(id)}) == 1


@EVERY_ID
def test_truncates_exactly_at_the_time_limit(id):
    environment = make(id)
    limit = environment.max_episode_steps
    env_state = start_world(environment, jax.random.key(1)).env_state
    truncated = []
    for step_count in (0, limit - 2, limit - 1, limit):
        before = dataclasses.replace(env_state, step_count=jnp.int32(step_count))
        transition = step_world(environment, before, action_of(environment, 0.0))[1]
        truncated.append(bool(transition.truncated))
        assert not transition.terminated
    assert truncated == [False, False, True, True]
    assert not dataclasses.replace(environment, max_episode_steps=None).is_truncated(jnp.int32(10**6))


@functools.partial(jax.jit, static_argnums=0)
def _value_and_derivatives(environment, action, options, weights):
    def value(action, options):
        env_state, _ = environment.reset(jax.random.key(3), options)
        return environment.step(env_state, action)[1] @ weights

    return jax.value_and_grad(value, argnums=(0, 1))(action, options)


@pytest.mark.slow
@EVERY_ID
def test_reverse_derivatives_through_reset_and_step_equal_central_differences(id, float64):
    environment = make(id)
    generator = np.random.default_rng(0)
    weights = jnp.asarray(generator.normal(size=environment.observation_size))
    arguments = (
        action_of(environment, 0.2).astype(float),
        {name: jnp.asarray(generator.uniform(-0.05, 0.05, shape)) for name, shape in environment.reset_options.items()},
    )
    gradients = _value_and_derivatives(environment, *arguments, weights)[1]
    leaves, structure = jax.tree.flatten(arguments)
    for index, leaf in enumerate(leaves):
        change = 1e-6 * jnp.asarray(generator.normal(size=leaf.shape))

        def value(sign, index=index, change=change):
            moved = [leaf + sign * change if place == index else leaf for place, leaf in enumerate(leaves)]
            return float(_value_and_derivatives(environment, *structure.unflatten(moved), weights)[0])

        truth = (value(1) - value(-1)) / 2
        assert abs(truth) > 1e-10
        # The engine differentiates the solved constraints, in twice its ten sweeps; the differences see the sweeps.
        assert float(jnp.vdot(jax.tree.leaves(gradients)[index], change)) == pytest.approx(truth, rel=0.03)


@EVERY_ID
def test_actions_beyond_the_bounds_are_clipped(id):
    environment = make(id)
    env_state = start_world(environment, jax.random.key(0)).env_state
    at_the_bound = step_world(environment, env_state, jnp.asarray(environment.action_space.high))[1]
    beyond = step_world(environment, env_state, 10 * jnp.asarray(environment.action_space.high))[1]
    np.testing.assert_array_equal(at_the_bound.observation, beyond.observation)
    np.testing.assert_array_equal(at_the_bound.reward, beyond.reward)


@EVERY_ID
def test_a_non_finite_world_terminates_and_leaves_the_others_bitwise_alone(id):
    environment = make(id)
    worlds = start_worlds(environment, keys(3))
    actions = jnp.tile(action_of(environment), (3, 1))
    healthy, broken = worlds, worlds
    for time in range(3):
        healthy, expected = step_worlds(environment, healthy, actions)
        broken, transition = step_worlds(environment, broken, actions.at[1].set(jnp.nan) if time == 0 else actions)
        np.testing.assert_array_equal(transition.terminated, [False, True, False])
        np.testing.assert_array_equal(transition.info["non_finite"], [False, True, False])
        assert all(not value[1].any() for name, value in transition.info.items() if name != "non_finite")
        assert transition.reward[1] == 0.0
        assert np.isfinite(transition.observation).all()
        for name in ("observation", "reward", "truncated"):
            got, want = np.asarray(getattr(transition, name)), np.asarray(getattr(expected, name))
            np.testing.assert_array_equal(got[[0, 2]], want[[0, 2]], err_msg=name)
    assert not expected.terminated.any()


@pytest.mark.parametrize("id", slow_but(("mathota/InvertedPendulum-v0",), ENVIRONMENTS))
def test_the_model_can_be_replaced_in_a_step(id):
    environment = make(id)
    env_state = start_world(environment, jax.random.key(0)).env_state
    weightless = dataclasses.replace(environment.model, gravity=jnp.zeros(3))
    action = action_of(environment, 0.0)
    own = environment.step(env_state, action)[1]  # public functions are compiled without jax.jit around them
    np.testing.assert_array_equal(environment.step(env_state, action, environment.model)[1], own)
    assert not np.array_equal(environment.step(env_state, action, weightless)[1], own)


@EVERY_ID
def test_environments_can_be_made_inside_a_traced_function(id):
    made = []
    jax.jit(lambda x: made.append(make(id)) or x)(0.0)
    assert not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((made[0].model, made[0].rest_state)))


@EVERY_ID
def test_the_state_converts_to_numpy(id):
    env_state = start_world(make(id), jax.random.key(0)).env_state
    assert isinstance(jax.tree.map(np.asarray, env_state), EnvState)


def test_unknown_environment_is_named_with_the_known_ones():
    with pytest.raises(ValueError, match=r"unknown environment 'mathota/Nothing-v0'.*mathota/BallBalance-v0"):
        make("mathota/Nothing-v0")
    with pytest.raises(ValueError, match="unknown environment None"):
        make(None)


@EVERY_ID
def test_unknown_option_is_named_with_the_valid_ones(id):
    with pytest.raises(ValueError, match=r"unknown option 'colour'; valid options: max_episode_steps"):
        make(id, colour="red")


@EVERY_ID
@pytest.mark.parametrize("name", ["max_episode_steps", "frame_skip", "substeps"])
@pytest.mark.parametrize("value", [0, -1, 1.5, True, "2"])
def test_impossible_counts_are_refused(id, name, value):
    with pytest.raises(ValueError, match=f"{name} must be an integer of at least 1"):
        make(id, **{name: value})


@pytest.mark.parametrize(
    ("id", "name", "value"),
    [
        ("mathota/InvertedPendulum-v0", "reset_noise_scale", -0.1),
        ("mathota/InvertedPendulum-v0", "reset_noise_scale", float("nan")),
        ("mathota/BallBalance-v0", "target_amplitude", 1.0),
        ("mathota/BallBalance-v0", "start_radius", "large"),
    ],
)
def test_impossible_numbers_are_refused(id, name, value):
    with pytest.raises(ValueError, match=f"{name} must be a number between"):
        make(id, **{name: value})


@EVERY_ID
def test_wrong_action_and_reset_options_are_refused(id):
    environment = make(id)
    env_state, _ = environment.reset(jax.random.key(0))
    with pytest.raises(ValueError, match="an action must have shape"):
        environment.step(env_state, jnp.zeros(7))
    with pytest.raises(ValueError, match=r"unknown reset option 'speed'; valid options: "):
        environment.reset(jax.random.key(0), {"speed": 1.0})
    name = next(iter(environment.reset_options))
    with pytest.raises(ValueError, match=f"reset option '{name}' must have shape"):
        environment.reset(jax.random.key(0), {name: jnp.zeros(5)})
    with pytest.raises(ValueError, match=f"reset option '{name}' must be numbers"):
        environment.reset(jax.random.key(0), {name: "left"})


def test_the_public_names_exist():
    assert all(hasattr(mathota_envs, name) for name in mathota_envs.__all__)
