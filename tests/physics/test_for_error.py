"""`Options.for_error`: what it promises holds, within a factor of two, against the truths of the benchmark scenes."""

import pytest

from mathota_jax import Options, measured
from tests.benchmarks.work_precision import engine
from tests.benchmarks.work_precision.scenes import SCENES, start_of
from tests.marks import slow_but

ERRORS = (3e-1, 1e-1, 3e-2, 1e-2, 3e-3, 1e-3)
FACTOR = 2.0
SINGLE = ("slide", "bounce", "roll", "tumble")


def reached(name, options):
    """Largest error over the worlds of a scene, relative to its scale."""
    scene = SCENES[name]
    program = engine.of_options(scene, options, scene.worlds)
    frames = program.record(scene, options.dt)
    assert frames.finite
    return scene.judge(start_of(name, scene.worlds), frames, options.dt).max() / scene.scale


def least_error(kind):
    """The smallest error that the table offers for a kind."""
    return min(entry["error"] for entry in measured.table()["entries"] if entry["kind"] == kind)


def offered(kind):
    return [error for error in ERRORS if error >= least_error(kind)]


@pytest.mark.parametrize("name", slow_but((*SINGLE, "stack10"), (*SINGLE, "stack10", "massratio")))
def test_the_promise_for_the_kind_of_a_scene(name, gate):
    error = max(1e-2, least_error(SCENES[name].kind))
    gate("error", reached(name, Options.for_error(error, SCENES[name].kind)), FACTOR * error)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(SCENES))
def test_the_promise_at_every_error_and_for_any_scene(name, gate):
    for kind in (SCENES[name].kind, "any"):
        strictest = {
            Options.for_error(error, kind): error for error in offered(kind)
        }  # errors fall: the last one stays
        for options, error in strictest.items():
            gate(f"{kind}, {options.solver} at {options.dt:.4g} s", reached(name, options), FACTOR * error)


@pytest.mark.parametrize("kind", measured.kinds())
def test_less_error_never_costs_less(kind):
    choices = [measured.cheapest(error, kind) for error in offered(kind)]
    assert choices
    assert all(choice.error <= error for choice, error in zip(choices, offered(kind), strict=True))
    assert sorted(choice.cost for choice in choices) == [choice.cost for choice in choices]


def test_other_options_are_kept_and_damping_is_off():
    options = Options.for_error(0.1, "single", sleep=True, angular_damping=0.2)
    assert options.sleep and options.angular_damping == 0.2 and options.linear_damping == 0.0


@pytest.mark.parametrize("error", [0.0, 1.0, -1e-3, float("nan"), float("inf"), "small", True])
def test_an_error_out_of_range(error):
    with pytest.raises(ValueError, match=r"Options\.for_error: error must lie between 0 and 1"):
        Options.for_error(error)


def test_an_error_that_no_setting_reaches_says_what_is_reached():
    with pytest.raises(ValueError, match=r"kind 'stack'; the least is"):
        Options.for_error(1e-12, "stack")


def test_an_unknown_kind_names_the_known_ones():
    with pytest.raises(ValueError, match=r"kind must be one of 'any', .*'stack'.*got 'tower'"):
        Options.for_error(0.1, "tower")
