"""A report as Markdown. The JSON beside it holds every round."""

from __future__ import annotations

from tests.benchmarks.figures import figures, rate

MARKS = {True: "yes", False: "**no**", None: ""}


def markdown(report: dict) -> str:
    """The whole report."""
    machine, settings = report["machine"], report["settings"]
    lines = [
        "# Speed against error",
        "",
        "Written by `python -m tests.benchmarks`; do not edit. Every round is in `report.json`.",
        "",
        f"- Machine: {machine['processor']}, {machine['cores']} cores; {', '.join(_versions(machine))}",
        f"- Run: {report['date']}, mode {settings['mode']}, {settings['rounds']} interleaved rounds of blocks of at "
        f"least {settings['block_seconds']} CPU-seconds; figures are medians, ratios are taken within a round",
        "- Rates are per CPU-second (`time.process_time`, all threads), after compilation and warm-up; compile time is "
        "measured apart",
    ]
    if settings["mode"] == "quick":
        lines.append("- **Quick run: too short for publication**")
    lines += ["", "| figure | measured | target | met | settings |", "|---|---|---|---|---|"]
    lines += [
        f"| {line.name} | {line.value} | {line.target} | {MARKS[line.met]} | {line.settings} |"
        for line in figures(report)
    ]
    for scene in ("slide", "bounce"):
        result = report["measurements"].get(scene)
        if result and "failed" not in result:
            lines += ["", f"## All of {scene}", "", *_contestants(result)]
    lines += ["", "Error against cost in more scenes, with more engines: [work_precision.md](work_precision.md).", ""]
    return "\n".join(lines)


def _versions(machine: dict) -> list[str]:
    return [f"{name} {version}" for name, version in machine["versions"].items()]


def _contestants(result: dict) -> list[str]:
    lines = [
        "| contestant | world-steps per CPU-second | 5-95 % | per wall second | errors |",
        "|---|---|---|---|---|",
    ]
    for name, entry in result["contestants"].items():
        cpu = entry["cpu_rate"]
        errors = ", ".join(f"{key} {value:.2g}" for key, value in (entry["error"] or {}).items())
        spread = f"{rate(cpu['p5'])} - {rate(cpu['p95'])}"
        lines.append(f"| {name} | {rate(cpu['median'])} | {spread} | {rate(entry['wall_rate']['median'])} | {errors} |")
    ratios = ", ".join(f"{count}: {ratio['median']:.2f}" for count, ratio in result["to_hand_batched"].items())
    lines += ["", f"`vmap(step)` over the hand-batched call, by number of worlds: {ratios}."]
    lines += [f"{name}: {reason}." for name, reason in result["missing"].items()]
    return lines
