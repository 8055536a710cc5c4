"""The work-precision report as Markdown. The JSON beside it holds every round."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from tests.benchmarks.figures import rate
from tests.benchmarks.work_precision import fronts
from tests.benchmarks.work_precision.gradient import GRADIENT
from tests.benchmarks.work_precision.limits import LIMITS
from tests.benchmarks.work_precision.plots import error_text, relative
from tests.benchmarks.work_precision.scenes import SCENES
from tests.benchmarks.work_precision.sweep import OURS


def markdown(report: dict) -> str:
    """The whole report."""
    settings, machine = report["settings"], report["machine"]
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
    scenes = {name: result for name, result in report["scenes"].items() if "failed" not in result}
    lines = [
        "# Work and precision",
        "",
        "Written by `python -m tests.benchmarks.work_precision`; do not edit. Every round is in `work_precision.json`.",
        "",
        f"- Machine: {machine['processor']}, {machine['cores']} cores{_other_processors(report)}; {versions}",
        f"- Run: {_dates(report)}, mode {settings['mode']}, up to {settings['rounds']} interleaved rounds; rates are "
        "medians of world-steps per CPU-second (`time.process_time`, all threads) over the whole horizon of the run whose "
        "error is given, after compilation; largest error over the worlds of a batch that differ",
        "- Ours: `vmap(step)` in a loop, float32, no damping, otherwise the defaults of the named setting; the number of "
        "worlds is the best of those tried with the first setting. Peers: MuJoCo and PyBullet one world after the other in "
        "one thread, float64; MJX and Brax a batch, float32. Their defaults and a tuned profile, named below. Runs of more "
        "than two seconds are timed once",
    ]
    if settings["mode"] == "quick":
        lines.append("- **Quick run: few rounds and batches, too short for publication**")
    lines += [
        f"- **{name} failed**: {result['failed']}" for name, result in report["scenes"].items() if "failed" in result
    ]
    lines += ["", "![cost of the error of the target](work_precision_summary.png)", ""]
    lines += ["![error against work in every scene](work_precision.png)", ""]
    lines += [
        "Thin lines join the time steps of a setting; the thick line is the Pareto front of mathota_jax; a cross marks the "
        "target, at dt 1/240 s.",
        "",
    ]
    lines += _scenes(scenes) + _targets(scenes) + _peers(scenes) + _time_to_error(scenes)
    lines += _extras(report) + _batches(scenes) + _table(report)
    for name, result in scenes.items():
        lines += _points(name, result)
    return "\n".join(lines) + "\n"


def _parts(report: dict) -> dict:
    """What was measured, by name."""
    return report["scenes"] | {name: report[name] for name in ("features", "scaling") if name in report}


def _other_processors(report: dict) -> str:
    """Those of what was measured elsewhere: rates compare within a scene, not across machines."""
    elsewhere: dict[str, list[str]] = {}
    for name, part in _parts(report).items():
        if part["processor"] != report["machine"]["processor"]:
            elsewhere.setdefault(part["processor"], []).append(name)
    return "".join(f" ({processor}: {', '.join(names)})" for processor, names in elsewhere.items())


def _dates(report: dict) -> str:
    """Days of measurement, the latest first, and what was measured on all but that one."""
    parts = _parts(report)
    latest, *others = sorted({part["date"] for part in parts.values()}, reverse=True)
    of_day = (", ".join(name for name, part in parts.items() if part["date"] == day) for day in others)
    return "; ".join((latest, *(f"{day}: {names}" for day, names in zip(others, of_day, strict=True))))


def _row(cells: Iterable[Any]) -> str:
    return "| " + " | ".join(str(cell) for cell in cells) + " |"


def _head(*names: str) -> list[str]:
    return [_row(names), "|---" * len(names) + "|"]


def _dt(value: float) -> str:
    return f"1/{1 / value:.0f}"


def _scenes(scenes: dict[str, dict]) -> list[str]:
    lines = ["## Scenes", "", *_head("scene", "error", "unit", "counts as 1 in plots and tables", "seconds")]
    for name in scenes:
        if name in SCENES:
            scene = SCENES[name]
            unit = "relative" if scene.unit == "1" else scene.unit
            lines.append(_row((name, scene.truth, unit, f"{scene.scale:g}", f"{scene.seconds:g}")))
        else:
            lines.append(_row((name, GRADIENT.truth, "relative", 1, 2)))
    return [*lines, ""]


def _targets(scenes: dict[str, dict]) -> list[str]:
    lines = ["## Targets", "", "Our fastest setting at dt 1/240 s whose error is at most that of the target.", ""]
    lines += _head("scene", "target", "measured", "error", "setting", "met", "what limits it")
    for name, result in scenes.items():
        if name not in SCENES:
            continue
        target, points = SCENES[name].target, result["points"]
        found, ratio = fronts.verdict(name, points)
        aim = f"{rate(target.rate)} at {error_text(name, target.error)}"
        if found is None:
            least = min(
                fronts.judged(fronts.at(fronts.of(points, OURS))), key=lambda point: point["error"], default=None
            )
            words = f"least error {error_text(name, least['error'])}" if least else "no finite run"
            lines.append(_row((name, aim, "-", words, "-", "**no**", LIMITS.get(name, ""))))
            continue
        met = "yes" if ratio >= 1 else f"**no, {1 / ratio:.2g}x short**"
        shown = (rate(found["rate"]), error_text(name, found["error"]), found["setting"], met)
        lines.append(_row((name, aim, *shown, "" if ratio >= 1 else LIMITS.get(name, ""))))
    return [*lines, ""]


def _peers(scenes: dict[str, dict]) -> list[str]:
    lines = ["## Against peers at dt 1/240 s", "", "Our fastest setting whose error is no larger than the peer's.", ""]
    lines += _head("scene", "peer", "its rate", "its error", "our rate", "our error", "our setting", "ours over its")
    for name, result in scenes.items():
        for peer in fronts.at(result["points"]):
            if peer["engine"] == OURS:
                continue
            label = f"{peer['engine']}, {peer['setting']}"
            if peer["error"] is None:
                lines.append(_row((name, label, rate(peer["rate"]), "not finite", *4 * ("-",))))
                continue
            found, ratio = fronts.against(result["points"], peer)
            shown = (name, label, rate(peer["rate"]), error_text(name, peer["error"]))
            if found is None:
                lines.append(_row((*shown, *3 * ("-",), "none so exact")))
            else:
                ours = (rate(found["rate"]), error_text(name, found["error"]), found["setting"], f"{ratio:.3g}x")
                lines.append(_row((*shown, *ours)))
    return [*lines, ""]


def _time_to_error(scenes: dict[str, dict]) -> list[str]:
    """T(eps): cheapest cost at which a relative error is reached, each engine."""
    lines = ["## Time to an error", ""]
    lines += [
        "CPU-microseconds per simulated second and world of the cheapest point whose relative error is at most eps.",
        "",
    ]
    lines += _head("scene", "engine", *(f"{eps:.0e}" for eps in fronts.RELATIVE_ERRORS))
    for name, result in scenes.items():
        for engine in fronts.engines(result["points"]):
            own, cells = fronts.of(result["points"], engine), []
            for eps in fronts.RELATIVE_ERRORS:
                point = fronts.cheapest(own, eps / relative(name, 1.0))
                cells.append(f"{1e6 * fronts.cost(point):.3g}" if point else "-")
            lines.append(_row((name, engine, *cells)))
    return [*lines, ""]


def _extras(report: dict) -> list[str]:
    lines: list[str] = []
    features, scaling = report.get("features"), report.get("scaling")
    if features and "failed" not in features:
        lines += ["## Cost of each feature", ""]
        lines += [f"One body at dt {_dt(features['dt'])} s, {features['worlds']} worlds.", ""]
        lines += _head("scene", "equations", "world-steps per CPU-second", "bytes a world", "compile [CPU-s]")
        for name, row in features["rows"].items():
            cells = (row["equations"], rate(row["rate"]), f"{row['bytes_per_world']:.0f}")
            lines.append(_row((name, *cells, f"{row['compile_cpu_seconds']:.1f}")))
        lines.append("")
    if scaling and "failed" not in scaling:
        lines += _scaling(scaling)
    return lines


def _scaling(found: dict) -> list[str]:
    lines = ["## Scaling", "", "Sliding cube at dt 1/240 s, and over MuJoCo with its defaults in the same rounds:", ""]
    lines += _head("worlds", "world-steps per CPU-second", "over MuJoCo", "per wall second", "bytes a world", "error")
    for row in found["worlds"]:
        ratio = f"{row['rate'] / row['mujoco_rate']:.3g}x" if row["mujoco_rate"] else "-"
        cells = (rate(row["rate"]), ratio, rate(row["wall_rate"]), f"{row['bytes_per_world']:.0f}")
        lines.append(_row((row["worlds"], *cells, error_text("slide", row["error"]))))
    lines += [
        "",
        "One world, one cube on a plane (targets: 60 us a call, 15 us inside a loop). What a call costs is mostly what JAX "
        "takes to hand over each array, and a thread that waits for work, which counts as CPU time:",
        "",
        *_head("a step", "wall time [us]", "CPU time, all threads [us]"),
    ]
    forms = {
        "call": "`jax.jit(step)(model, state)`",
        "constant": "`jax.jit(functools.partial(step, model))(state)`",
        "loop": "inside a compiled loop",
    }
    for key, form in forms.items():
        times = found["single"][key]
        lines.append(_row((form, f"{times['wall_microseconds']:.0f}", f"{times['cpu_microseconds']:.0f}")))
    lines += [
        "",
        "Spheres above a plane, one world, CPU-milliseconds a step, and pairs held (see `body_count.py`):",
        "",
    ]
    names = [key for key in found["bodies"][0] if isinstance(found["bodies"][0][key], dict)]
    lines += _head("bodies", "contacts from", "slots", "compile [CPU-s]", *names)
    for row in found["bodies"]:
        cells = (f"{row[key]['milliseconds']:.2f}" + _pairs(row[key]["pairs"]) for key in names)
        lines.append(_row((row["bodies"], row["method"], row["slots"], f"{row['compile']:.1f}", *cells)))
    return [*lines, ""]


def _pairs(count: int) -> str:
    """Pairs that the broadphase holds; it is absent where every pair has slots of its own."""
    return f" ({count})" if count >= 0 else ""


def _batches(scenes: dict[str, dict]) -> list[str]:
    lines = ["## Number of worlds, compile time, memory", ""]
    lines += [
        "World-steps per CPU-second of the first steps with the first setting, by number of worlds; CPU-seconds to "
    ]
    lines += ["compile each setting; bytes a world of arguments, results and temporaries.", ""]
    lines += _head("scene", "rate by number of worlds", "compile [CPU-s]", "bytes a world")
    for name, result in scenes.items():
        rates = ", ".join(f"{entry['batch']}: {rate(entry['rate'])}" for entry in result["batches"])
        settings = {point["setting"]: point for point in fronts.of(result["points"], OURS)}
        compiles = ", ".join(f"{key} {point['compile_cpu_seconds']:.0f}" for key, point in settings.items())
        memory = ", ".join(f"{key} {point['bytes_per_world']:.0f}" for key, point in settings.items())
        lines.append(_row((name, rates or "-", compiles, memory)))
    return [*lines, ""]


def _table(report: dict) -> list[str]:
    table = report.get("error_table")
    if not table:
        return []
    lines = ["## What `Options.for_error` chooses from", ""]
    lines += [
        "Worst relative error and mean CPU-microseconds per simulated second and world over the scenes of a kind.",
        "",
    ]
    lines += _head("kind", "scenes", "setting", "dt", "worst error", "mean cost [us]")
    for entry in table["entries"]:
        shown = (entry["setting"], _dt(entry["dt"]), f"{entry['error']:.2g}", f"{1e6 * entry['cost']:.3g}")
        lines.append(_row((entry["kind"], ", ".join(table["scenes"][entry["kind"]]), *shown)))
    return [*lines, ""]


def _points(name: str, result: dict) -> list[str]:
    lines = [f"## All of {name}", ""]
    profiles = {
        f"{point['engine']} {point['setting']}": point["profile"] for point in result["points"] if point["profile"]
    }
    lines += [f"- {label}: {given}" for label, given in profiles.items()]
    lines += [f"- {engine}: {reason}" for engine, reason in result["missing"].items()]
    lines += [
        "",
        *_head("engine", "setting", "dt", "worlds", "error", "median error", "world-steps per CPU-second", "front"),
    ]
    best = [id(point) for point in fronts.front(result["points"])]
    for point in result["points"]:
        error, median = point["error"], point.get("error_median")
        cells = ("not finite", "") if error is None else (error_text(name, error), error_text(name, median or error))
        mark = "yes" if id(point) in best else ""
        mark += f" (flags {point['flags']})" if point.get("flags") else ""
        shown = (point["engine"], point["setting"], _dt(point["dt"]), point["batch"], *cells, rate(point["rate"]), mark)
        lines.append(_row(shown))
    return [*lines, ""]


def summary(scenes: dict[str, dict]) -> str:
    """One line a scene, for the terminal."""
    lines = []
    for name, result in scenes.items():
        if name in SCENES and "failed" not in result:
            found, ratio = fronts.verdict(name, result["points"])
            words = f"{ratio:.3g}x the target" if found else "not reached"
            lines.append(f"{name}, error at most {error_text(name, SCENES[name].target.error)}: {words}")
    return "\n".join(lines)
