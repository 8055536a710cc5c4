"""Headline figures of a report, each with its target and the settings under which it was measured."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

SLIDE_TARGET, BOUNCE_TARGET, APEX_TARGET, HAND_BATCHED_TARGET = 4.0, 10.0, 0.01, 0.9
GRADIENT_TARGET, DERIVATIVE_TARGET, LINEARITY_TARGET = 4.0, 0.01, 0.02
COMPILE_TARGETS = {"one box on a plane": 2.0, "stack of ten boxes": 6.0}
SCENE_TITLES = {
    "tumble": "torque-free tumble",
    "stopping_distance": "stopping distance",
    "incline": "incline",
    "tipping": "tipping on an incline",
    "slide_to_roll": "slide to roll",
    "stack": "stack of ten boxes",
}


@dataclasses.dataclass(frozen=True)
class Figure:
    """One line of the report. `target` is text; `met` is None where there is no target."""

    name: str
    value: str
    target: str
    met: bool | None
    settings: str


def figures(report: dict) -> list[Figure]:
    """All headline figures of what was measured; a measurement that failed gives one line that says why."""
    makers = {
        "slide": _slide,
        "bounce": _bounce,
        "gradient": _gradient,
        "compile_time": _compile_time,
        "accuracy": _accuracy,
    }
    lines: list[Figure] = []
    for name, make in makers.items():
        result = report["measurements"].get(name)
        if result is None:
            continue
        if "failed" in result:
            lines.append(Figure(name, "failed", "", False, result["failed"]))
        else:
            lines.extend(make(result))
    return lines


def rate(value: float) -> str:
    """A rate with three digits."""
    return f"{value / 1e6:.3g} M/s" if value >= 1e6 else f"{value / 1e3:.3g} k/s"


def percent(value: float) -> str:
    """A ratio in percent with two digits."""
    return f"{100 * value:.2g} %"


def _at_least(name: str, value: float, target: float, settings: str) -> Figure:
    return Figure(name, f"{value:.2f}x", f"at least {target:g}x", value >= target, settings)


def _slide(result: dict) -> Iterator[Figure]:
    own = result["contestants"][result["best"]]
    settings = _own_settings(own)
    error = own["error"]
    yield Figure("sliding cube, world-steps per CPU-second", rate(own["cpu_rate"]["median"]), "", None, settings)
    yield Figure("sliding cube, error of the stopping distance", percent(error["distance_error"]), "", None, settings)
    for peer, ratio in result["ratios"].items():
        target = SLIDE_TARGET if peer.startswith("MuJoCo") else None
        yield _ratio("sliding cube", peer, ratio["median"], target, result["contestants"][peer], "distance_error")
    yield from _hand_batched("sliding cube", result)


def _bounce(result: dict) -> Iterator[Figure]:
    own = result["contestants"][result["best"]]
    settings = _own_settings(own)
    apex = own["error"]["apex_error"]
    yield Figure("bouncing sphere, world-steps per CPU-second", rate(own["cpu_rate"]["median"]), "", None, settings)
    yield Figure(
        "bouncing sphere, error of the first apex",
        percent(apex),
        f"at most {percent(APEX_TARGET)}",
        apex <= APEX_TARGET,
        settings,
    )
    for peer, ratio in result["ratios"].items():
        target = BOUNCE_TARGET if peer.startswith("MuJoCo") else None
        yield _ratio("bouncing sphere", peer, ratio["median"], target, result["contestants"][peer], "apex_error")
    yield from _hand_batched("bouncing sphere", result)


def _own_settings(own: dict) -> str:
    settings = own["settings"]
    contacts = own["error"]["mean_contacts"]
    return (
        f"vmap(step) in a scan, {settings['batch']} worlds, dt 1/{1 / settings['dt']:.0f} s, {settings['sweeps']} "
        f"sweeps, {settings['precision']}, {contacts:.2g} loaded contacts on average"
    )


def _ratio(scene: str, peer: str, ratio: float, target: float | None, contestant: dict, error_name: str) -> Figure:
    own_error = contestant.get("error") or {}
    notes = [rate(contestant["cpu_rate"]["median"])]
    if error_name in own_error:
        notes.append(f"error {percent(own_error[error_name])}")
    if "mean_contacts" in own_error:
        notes.append(f"{own_error['mean_contacts']:.2g} contacts on average")
    name = f"{scene}, rate over that of {peer}"
    settings = "peer: " + ", ".join(notes)
    if target is None:
        return Figure(name, f"{ratio:.3g}x", "", None, settings)
    return _at_least(name, ratio, target, settings)


def _hand_batched(scene: str, result: dict) -> Iterator[Figure]:
    ratio = result["to_hand_batched"][str(result["best_batch"])]["median"]
    name = f"{scene}, vmap(step) over the hand-batched call"
    yield _at_least(name, ratio, HAND_BATCHED_TARGET, f"{result['best_batch']} worlds")


def _gradient(result: dict) -> Iterator[Figure]:
    shared = result["contestants"]["forward"]["settings"]
    settings = f"{shared['steps']} steps of the sliding cube, {shared['batch']} worlds, by launch speed and friction"
    cost = result["cost_ratio"]["median"]
    target = f"at most {GRADIENT_TARGET:g}x"
    yield Figure(
        "value and gradient over forward, CPU-seconds", f"{cost:.2f}x", target, cost <= GRADIENT_TARGET, settings
    )
    for group, title in (("sliding", "sliding"), ("stopped", "after the stop")):
        for name, error in result[group].items():
            strict = name == "dx/dv"
            limit = f"at most {percent(DERIVATIVE_TARGET)}" if strict else ""
            met = error <= DERIVATIVE_TARGET if strict else None if math.isfinite(error) else False
            yield Figure(f"{name} {title}, relative error to the closed form", percent(error), limit, met, settings)
    memory = result["memory"]
    deviation = memory["deviation_from_line"]
    yield Figure(
        "memory of the gradient, largest deviation from a line in the steps",
        percent(deviation),
        f"at most {percent(LINEARITY_TARGET)}",
        deviation <= LINEARITY_TARGET,
        f"{memory['bytes_per_world_step']:.0f} bytes per world-step, steps {memory['steps']}",
    )


def _compile_time(result: dict) -> Iterator[Figure]:
    for name, target in COMPILE_TARGETS.items():
        times = result[name]
        value = times["compile_seconds"]
        settings = (
            f"trace {times['trace_seconds']:.2f} s + XLA {times['xla_seconds']:.2f} s of wall time in a fresh process "
            f"without cache; {times['compile_cpu_seconds']:.2f} CPU-seconds; XLA {times['older_xla_seconds']:.2f} s with "
            "`XLA_FLAGS=--xla_cpu_use_fusion_emitters=false`"
        )
        yield Figure(
            f"compile time of a step, {name}", f"{value:.2f} s", f"at most {target:g} s", value <= target, settings
        )


def _accuracy(result: dict) -> Iterator[Figure]:
    for scene, values in result.items():
        rest = ", ".join(f"{name} {_setting(name, value)}" for name, value in values["settings"].items())
        settings = f"{rest}; {values['cpu_seconds']:.2g} CPU-seconds"
        for name, entry in values.items():
            if name in ("settings", "cpu_seconds"):
                continue
            limit = _text(entry["gate"]) if "gate" in entry else ""
            yield Figure(f"{SCENE_TITLES[scene]}: {name}", _text(entry["value"]), limit, entry.get("met"), settings)


def _setting(name: str, value: object) -> str:
    return f"1/{1 / value:.0f} s" if name == "dt" and isinstance(value, float) else _text(value)


def _text(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.3g}"
    return ", ".join(_text(item) for item in value) if isinstance(value, list) else str(value)
