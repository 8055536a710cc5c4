"""`GymVectorEnv` against `gymnasium.vector.SyncVectorEnv` over single environments, in all three autoreset modes."""

import dataclasses

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from mathota_envs import ENVIRONMENTS, GymEnv, GymVectorEnv
from tests.envs.counting import Counting
from tests.marks import slow_but

EVERY_ID = pytest.mark.parametrize("id", ENVIRONMENTS)
EVERY_MODE = pytest.mark.parametrize("mode", list(AutoresetMode))
WORLDS = 4


def assert_same(got, want, path="result"):
    """Equality of nested results: values, types, shapes and the keys of every info."""
    if isinstance(want, dict):
        assert got.keys() == want.keys(), f"{path}: {sorted(got)} != {sorted(want)}"
        for key in want:
            assert_same(got[key], want[key], f"{path}[{key!r}]")
    elif isinstance(want, tuple):
        assert len(got) == len(want)
        for index, (a, b) in enumerate(zip(got, want, strict=True)):
            assert_same(a, b, f"{path}[{index}]")
    elif isinstance(want, np.ndarray) and want.dtype == object:
        for index, (a, b) in enumerate(zip(got, want, strict=True)):
            assert (a is None) == (b is None), f"{path}[{index}]"
            if b is not None:
                assert_same(a, b, f"{path}[{index}]")
    else:
        assert got.dtype == want.dtype and got.shape == want.shape, f"{path}: {got.dtype} {got.shape}"
        np.testing.assert_array_equal(got, want, err_msg=path)


def actions_at(time):
    """Some worlds rise fast and terminate, some hover and are truncated."""
    return np.array([[1.0], [0.0], [0.75 if time % 2 else 1.0], [-0.5]], np.float32)


@pytest.fixture
def pair(request):
    mode = request.getfixturevalue("mode")
    ours = GymVectorEnv(Counting(), WORLDS, autoreset_mode=mode)
    theirs = SyncVectorEnv([lambda: GymEnv(Counting())] * WORLDS, autoreset_mode=mode)
    return ours, theirs


@EVERY_MODE
def test_equals_sync_vector_env_through_many_episodes(mode, pair):
    ours, theirs = pair
    assert ours.metadata["autoreset_mode"] is mode
    assert_same(ours.reset(seed=7), theirs.reset(seed=7))
    ends = {"terminated": 0, "truncated": 0}
    for time in range(40):
        got, want = ours.step(actions_at(time)), theirs.step(actions_at(time))
        assert_same(got, want, f"step {time}")
        ends["terminated"] += want[2].sum()
        ends["truncated"] += want[3].sum()
        done = want[2] | want[3]
        if mode is AutoresetMode.DISABLED and done.any():
            assert_same(ours.reset(options={"reset_mask": done}), theirs.reset(options={"reset_mask": done.copy()}))
    assert min(ends.values()) >= 5, "both kinds of end must have happened"


@EVERY_MODE
def test_masked_reset_equals_sync_vector_env(mode, pair):
    ours, theirs = pair
    assert_same(ours.reset(seed=1), theirs.reset(seed=1))
    assert_same(ours.step(actions_at(0)), theirs.step(actions_at(0)))
    mask = np.array([True, False, True, False])
    for seed in (None, 30, [None, 4, 5, 6]):
        given = {"reset_mask": mask}
        assert_same(ours.reset(seed=seed, options=given), theirs.reset(seed=seed, options={"reset_mask": mask.copy()}))
        assert "reset_mask" in given, "the caller's dictionary must stay as it was"
        for time in range(3):
            got, want = ours.step(actions_at(time)), theirs.step(actions_at(time))
            assert_same(got, want)
            done = want[2] | want[3]
            if mode is AutoresetMode.DISABLED and done.any():
                assert_same(ours.reset(options={"reset_mask": done}), theirs.reset(options={"reset_mask": done.copy()}))


@EVERY_MODE
def test_a_full_reset_forgets_finished_episodes(mode, pair):
    ours, theirs = pair
    assert_same(ours.reset(seed=1), theirs.reset(seed=1))
    for time in range(20):
        got, want = ours.step(actions_at(time)), theirs.step(actions_at(time))
        assert_same(got, want)
        if (want[2] | want[3]).any():
            break
    assert_same(ours.reset(), theirs.reset())
    assert_same(ours.step(actions_at(0)), theirs.step(actions_at(0)))


@pytest.mark.parametrize("mode", [AutoresetMode.DISABLED])
def test_disabled_refuses_to_step_finished_worlds(mode, pair):
    ours, theirs = pair
    for environment, error in ((ours, ResetNeeded), (theirs, AssertionError)):
        environment.reset(seed=0)
        with pytest.raises(error):
            for time in range(10):
                environment.step(actions_at(time))


@pytest.mark.parametrize("seed", [3, [9, 1, 4, 9]])
def test_seeds_of_worlds(seed):
    environment = GymVectorEnv(Counting(), WORLDS)
    single_seeds = [seed + i for i in range(WORLDS)] if isinstance(seed, int) else seed
    observations, _ = environment.reset(seed=seed)
    np.testing.assert_array_equal(observations, [GymEnv(Counting()).reset(seed=s)[0] for s in single_seeds])
    np.testing.assert_array_equal(environment.reset(seed=seed)[0], observations)
    assert not (environment.reset()[0] == observations).all(axis=1).any()
    if seed == 3:
        assert environment.np_random_seed == 3


def test_without_a_seed_the_starts_are_random():
    first, second = (GymVectorEnv(Counting(), WORLDS).reset()[0] for _ in range(2))
    assert len(np.unique(np.concatenate([first, second])[:, 0])) == 2 * WORLDS


@EVERY_MODE
def test_results_are_writable_copies(mode):
    environments = [GymVectorEnv(Counting(), WORLDS, autoreset_mode=mode) for _ in range(2)]
    results = []
    for spoil, environment in enumerate(environments):
        trace = [environment.reset(seed=0)]
        for time in range(12):
            result = environment.step(actions_at(time))
            trace.append(result)
            done = result[2] | result[3]
            if mode is AutoresetMode.DISABLED and done.any():
                trace.append(environment.reset(options={"reset_mask": done}))
            if spoil:
                for array in _arrays(trace[-1]):
                    array[...] = 77
        results.append(trace)
    assert_same(environments[1].reset(), environments[0].reset())
    assert_same(environments[1].step(actions_at(0)), environments[0].step(actions_at(0)))


def _arrays(result):
    for part in result.values() if isinstance(result, dict) else result:
        if isinstance(part, dict):
            yield from _arrays(part)
        elif part.dtype != object:
            yield part
        else:
            yield from (entry for entry in part if entry is not None)


@pytest.mark.parametrize("id", slow_but(("mathota/InvertedPendulum-v0",), ENVIRONMENTS))
def test_registered_vector_environment_equals_single_environments(id):
    assert gymnasium.make_vec(id, 3).metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    vector = gymnasium.make_vec(id, 3, autoreset_mode="SameStep")
    assert isinstance(vector, GymVectorEnv)
    singles = [gymnasium.make(id, disable_env_checker=True) for _ in range(3)]
    observations, _ = vector.reset(seed=11)
    np.testing.assert_allclose(
        observations, [single.reset(seed=11 + i)[0] for i, single in enumerate(singles)], rtol=1e-5, atol=1e-6
    )
    actions = np.linspace(-0.1, 0.1, 3)[:, None] * vector.single_action_space.high
    for _ in range(4):
        got = vector.step(actions)
        want = [single.step(action) for single, action in zip(singles, actions, strict=True)]
        # The same arithmetic, fused differently by the compiler: float32 round-off only.
        np.testing.assert_allclose(got[0], [w[0] for w in want], rtol=1e-4, atol=2e-5)
        np.testing.assert_allclose(got[1], [w[1] for w in want], rtol=1e-4)
        np.testing.assert_array_equal(got[2], [w[2] for w in want])
        np.testing.assert_array_equal(got[3], [w[3] for w in want])
        assert got[4].keys() == {key for name in want[0][4] for key in (name, f"_{name}")}


@EVERY_ID
def test_truncated_registered_worlds_start_anew_elsewhere(id):
    vector = gymnasium.make_vec(id, 3, autoreset_mode="SameStep")
    first, _ = vector.reset(seed=0)
    late = dataclasses.replace(
        vector.worlds.env_state, step_count=np.full(3, vector.environment.max_episode_steps - 1, np.int32)
    )
    vector.worlds = vector.worlds._replace(env_state=late)
    second, _, terminated, truncated, infos = vector.step(vector.action_space.sample() * 0)
    assert truncated.all() and not terminated.any() and infos["_final_obs"].all()
    assert not (second == first).all(axis=1).any()
    assert not (second == np.stack(infos["final_obs"])).all(axis=1).any()


@EVERY_ID
def test_a_non_finite_world_restarts_and_the_others_go_on_bitwise(id):
    clean, broken = (gymnasium.make_vec(id, 3, autoreset_mode="SameStep") for _ in range(2))
    start, _ = clean.reset(seed=2)
    broken.reset(seed=2)
    actions = np.tile(0.1 * clean.single_action_space.high, (3, 1))
    poisoned = actions.copy()
    poisoned[1] = np.nan
    want, got = clean.step(actions), broken.step(poisoned)
    assert got[2].tolist() == [False, True, False] and got[4]["final_info"]["non_finite"][1]
    assert got[1][1] == 0 and np.isfinite(got[0]).all() and np.isfinite(got[4]["final_obs"][1]).all()
    assert not np.array_equal(got[0][1], start[1])
    for _ in range(3):
        for mine, theirs in zip(got[:4], want[:4], strict=True):
            np.testing.assert_array_equal(mine[[0, 2]], theirs[[0, 2]])
        want, got = clean.step(actions), broken.step(actions)
        assert not got[2].any()


def test_gymnasium_wrappers_accept_it():
    environment = RecordEpisodeStatistics(GymVectorEnv(Counting(), WORLDS))
    environment.reset(seed=0)
    lengths = []
    for time in range(20):
        infos = environment.step(actions_at(time))[4]
        if "episode" in infos:
            lengths += infos["episode"]["l"][infos["_episode"]].tolist()
    assert max(lengths) == 5


def test_pictures_of_all_worlds():
    environment = gymnasium.make_vec("mathota/InvertedPendulum-v0", 2, render_mode="rgb_array", width=32, height=24)
    environment.reset(seed=0)
    frames = environment.render()
    assert len(frames) == 2 and all(f.shape == (24, 32, 3) and f.dtype == np.uint8 for f in frames)
    environment.close()
    environment.close()


def test_bad_input_is_named():
    environment = GymVectorEnv(Counting(), WORLDS)
    with pytest.raises(ResetNeeded, match="reset before step"):
        environment.step(actions_at(0))
    with pytest.raises(ResetNeeded, match="reset all worlds before"):
        environment.reset(options={"reset_mask": np.array([True, False, False, False])})
    environment.reset()
    with pytest.raises(ValueError, match=r"actions must have shape \(4, 1\), got \(4,\)"):
        environment.step(np.zeros(4))
    with pytest.raises(ValueError, match="one seed for each of the 4 worlds, got 3"):
        environment.reset(seed=[1, 2, 3])
    with pytest.raises(ValueError, match="reset options must be a dict of names and values, got 3"):
        environment.reset(options=3)
    with pytest.raises(ValueError, match="unknown reset option 'numbr'"):
        environment.reset(options={"numbr": 0.0})
    for mask, error, text in (
        ([True] * 4, TypeError, "must be a NumPy array of bool, got list"),
        (np.ones(4), TypeError, "must be a NumPy array of bool, got float64"),
        (np.ones(3, bool), ValueError, r"must have shape \(4,\), got \(3,\)"),
        (np.zeros(4, bool), ValueError, "at least one world"),
    ):
        with pytest.raises(error, match=text):
            environment.reset(options={"reset_mask": mask})
    with pytest.raises(ValueError, match=r"unknown autoreset_mode 'Never'; valid: .*'SameStep'"):
        GymVectorEnv(Counting(), autoreset_mode="Never")
    for count in (0, -2, 1.5, True):
        with pytest.raises(ValueError, match="num_envs must be a positive integer"):
            GymVectorEnv(Counting(), count)
    with pytest.raises(ValueError, match="unknown option 'colour'"):
        gymnasium.make_vec("mathota/BallBalance-v0", 2, colour="red")
