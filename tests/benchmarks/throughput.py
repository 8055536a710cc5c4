"""World-steps per CPU-second of the two scenes, beside the peers, with the error of the very same configuration."""

from __future__ import annotations

from collections.abc import Callable

from tests.benchmarks import jax_peers, mujoco_peer, native, ours, scenes
from tests.benchmarks.batched import BatchedScene
from tests.benchmarks.settings import TIME_STEP, Settings
from tests.benchmarks.timing import Contestant, interleave, paired_ratio


def measure(settings: Settings, scene: str) -> dict:
    """Measures one scene.

    Args:
      settings: settings of the run.
      scene: "slide" or "bounce".

    Returns:
      Every contestant's rates and error, the best batch of ours, and the ratios of it to the others.
    """
    make, steps, own_error = {
        "slide": (ours.slide, scenes.SLIDE_TIMED_STEPS, slide_error),
        "bounce": (ours.bounce, scenes.BOUNCE_TIMED_STEPS, bounce_error),
    }[scene]
    own = {f"vmap(step), batch {count}": _own(make, count, steps, own_error) for count in settings.batches}
    hand = {f"hand-batched, batch {count}": _native(make, count, steps) for count in settings.batches}
    peers, absent = {}, jax_peers.missing()
    if reason := mujoco_peer.missing():
        absent = {"MuJoCo": reason, **absent}
    else:
        peers.update(getattr(mujoco_peer, f"{scene}_contestants")())
        peers.update(getattr(jax_peers, f"{scene}_contestants")())
    interleave({**own, **hand, **peers}, settings)

    best = max(own, key=lambda name: own[name].report()["cpu_rate"]["median"])
    everyone = {**own, **hand, **peers}
    return {
        "best": best,
        "ratios": {name: paired_ratio(own[best], other) for name, other in peers.items()},
        "to_hand_batched": {
            str(count): paired_ratio(own[f"vmap(step), batch {count}"], hand[f"hand-batched, batch {count}"])
            for count in settings.batches
        },
        "best_batch": own[best].settings["batch"],
        "missing": absent,
        "contestants": {name: contestant.report() for name, contestant in everyone.items()},
    }


def _own(make: Callable, count: int, steps: int, error: Callable[[BatchedScene], dict]) -> Contestant:
    worlds = make(TIME_STEP, count)
    checked = {**error(worlds), **ours.check(worlds, steps)}
    return Contestant(
        worlds.block(steps), {"dt": TIME_STEP, "batch": count, "sweeps": 10, "precision": "float32"}, checked
    )


def _native(make: Callable, count: int, steps: int) -> Contestant:
    return Contestant(native.hand_batched(make(TIME_STEP, count), steps), {"dt": TIME_STEP, "batch": count})


def slide_error(worlds: BatchedScene, dt: float = TIME_STEP) -> dict:
    """Errors of the stopping distance."""
    track = worlds.track(scenes.step_count(scenes.SLIDE_SECONDS, dt))
    return scenes.slide_errors(scenes.spread(scenes.SLIDE_SPEEDS, worlds.count), track[-1] - track[0], dt)


def bounce_error(worlds: BatchedScene, dt: float = TIME_STEP) -> dict:
    """Errors of the first apex."""
    track = worlds.track(scenes.step_count(scenes.BOUNCE_SECONDS, dt))
    gaps = scenes.spread(scenes.BOUNCE_GAPS, worlds.count)
    return {
        **scenes.bounce_errors(gaps, scenes.first_apex(track)),
        "largest_penetration": float(max(0.0, -track.min())),
    }
