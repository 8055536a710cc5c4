"""Writes the generated parts of the README: what exists, and what was measured.

`python -m tests.status` rewrites them; `tests/unit/test_readme.py` fails when they are out of date. A feature counts as
existing when the code that makes it can be imported, and as working only with a test beside it.
"""

from __future__ import annotations

import importlib
import json
import pathlib
import re
import sys
from types import ModuleType
from typing import NamedTuple

from mathota_jax.collision.pairs import PAIRS
from mathota_jax.geometry import SHAPES
from tests.benchmarks.figures import Figure, figures

ROOT = pathlib.Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
REPORT = ROOT / "tests" / "benchmarks" / "results" / "report.json"
HEADLINES = (
    "world-steps per CPU-second",
    "error of the",
    "rate over that of",
    "vmap(step) over",
    "value and gradient over forward",
    "dx/dv sliding",
    "compile time",
)


class Feature(NamedTuple):
    """One line of the feature table: `module:attribute` that makes it, and the test (file or folder) that shows it."""

    name: str
    source: str
    test: str


FEATURES = (
    Feature(
        "`jit`, `vmap`, `grad`, `jacfwd`, `scan`, `checkpoint` in any order",
        "mathota_jax.batching:batch_last",
        "unit/test_batch_last.py",
    ),
    Feature(
        "gradients through contact, friction and impacts", "mathota_jax:rollout", "gradients/test_slide_gradient.py"
    ),
    Feature("isotropic friction cone", "mathota_jax.constraints:contact", "physics/test_slide.py"),
    Feature("restitution", "mathota_jax.constraints:contact", "physics/test_bounce.py"),
    Feature("warm-started projected Gauss-Seidel", "mathota_jax.solver:pgs", "physics/test_warm_start.py"),
    Feature("exact free flight, gyroscopic rotation", "mathota_jax.dynamics:free_motion", "physics/test_tumble.py"),
    Feature("hinge and slider with limits, damping, motors", "mathota_jax:Hinge", "physics/test_joints.py"),
    Feature("flags for worlds that go wrong", "mathota_jax:Flag", "unit/test_flags.py"),
    Feature("Gymnasium `Env` and `VectorEnv`", "mathota_envs:GymVectorEnv", "envs"),
    Feature("stable-baselines3 `VecEnv`", "mathota_envs:sb3", "envs"),
    Feature("training with PPO on the device", "training:ppo", "training"),
    Feature("ball, fixed and distance joints", "mathota_jax:BallAndSocket", "physics/test_joint_kinds.py"),
    Feature(
        "springs, dry friction, armature, velocity and position motors, joint forces",
        "mathota_jax:joint_forces",
        "physics/test_joint_drives.py",
    ),
    Feature("converged solver (experimental)", "mathota_jax.solver:converged", "physics/test_converged.py"),
    Feature("fast bodies stopped at the time of impact", "mathota_jax.dynamics:events", "physics/test_fast_bodies.py"),
    Feature("chains and trees of joints solved exactly", "mathota_jax.constraints:mechanism", "physics/test_chain.py"),
    Feature(
        "robots on feet far lighter than they are",
        "mathota_jax.constraints:mechanism_contacts",
        "physics/test_mechanism_contacts.py",
    ),
    Feature("jointed bodies that land and rebound as one", "mathota_jax.constraints:lever", "physics/test_landing.py"),
    Feature(
        "floors of several shapes, without bumps at their seams",
        "mathota_jax.constraints:flush",
        "physics/test_seams.py",
    ),
    Feature(
        "springs and servos of any stiffness",
        "mathota_jax.constraints:mechanism_drives",
        "physics/test_stiff_drives.py",
    ),
    Feature(
        "closed loops of joints solved exactly", "mathota_jax.constraints:mechanism_loops", "physics/test_loops.py"
    ),
    Feature("steps split at their impacts", "mathota_jax:impact_splitting", "physics/test_impact_events.py"),
    Feature("fitting parameters to recorded motion", "mathota_jax.fit:fit", "fit"),
    Feature(
        "gradients of long rollouts, missed contacts and expected losses",
        "mathota_jax.gradients:long_rollout",
        "gradients/test_long_rollout.py",
    ),
    Feature("policies by the gradient of the simulation", "training:short_horizon", "training/test_short_horizon.py"),
    Feature("settings by error target", "mathota_jax:measured", "physics/test_for_error.py"),
    Feature("fixed time step accumulator, interpolation", "mathota_jax:interpolate", "unit/test_time_stepping.py"),
    Feature("residuals, penetration, joint gaps, `describe`", "mathota_jax:residuals", "unit/test_residuals.py"),
    Feature("GJK, with EPA for curved shapes", "mathota_jax.collision:convex", "unit/test_convex.py"),
    Feature(
        "separating axes for convex polytopes",
        "mathota_jax.collision.convex:separating_axis",
        "unit/test_separating_axis.py",
    ),
    Feature("sleeping and islands", "mathota_jax.dynamics:sleep", "physics/test_sleep.py"),
    Feature("substepped soft contacts", "mathota_jax.solver:soft_step", "physics/test_soft_step.py"),
    Feature("reduced (joint) coordinates", "mathota_jax.dynamics:articulated", "physics/test_articulated.py"),
    Feature(
        "distance, manifold, time of impact of any two shapes", "mathota_jax:time_of_impact", "unit/test_queries.py"
    ),
    Feature("broadphase for scenes of many bodies", "mathota_jax.collision:broadphase", "unit/test_broadphase.py"),
    Feature("bodies that ignore each other", "mathota_jax:pair_filter", "unit/test_ignored_collisions.py"),
    Feature("raycast against every shape", "mathota_jax:raycast", "unit/test_raycast.py"),
    Feature("meshes (OBJ, STL), convex decomposition", "mathota_jax.io:meshes", "unit/test_meshes.py"),
    Feature("pictures of every shape, replays in a browser", "mathota_envs.render:render_rgb", "envs/test_render.py"),
    Feature("MJCF and URDF", "mathota_jax.io:mjcf", "unit/test_mjcf.py"),
)


def main() -> int:
    """Rewrites the README; returns the exit status."""
    README.write_text(render(README.read_text()))
    return 0


def render(text: str) -> str:
    """The README with its generated parts up to date."""
    for name, content in (("status", status()), ("figures", measured())):
        pattern = rf"(<!-- {name}:begin[^>]*-->\n).*?(<!-- {name}:end -->)"
        text, count = re.subn(pattern, lambda found, content=content: found[1] + content + found[2], text, flags=re.S)
        if count != 1:
            raise ValueError(f"README.md needs one pair of markers <!-- {name}:begin --> and <!-- {name}:end -->")
    return text


def status() -> str:
    """Shapes x pairs, then features."""
    kinds = list(SHAPES)
    lines = ["| contact points | " + " | ".join(kinds) + " |", "|---|" + "---|" * len(kinds)]
    lines += [f"| **{first}** | " + " | ".join(_pair(first, second) for second in kinds) + " |" for first in kinds]
    lines += ["", "| method | pairs |", "|---|---|"]
    for method in dict.fromkeys(pair.method for pair in PAIRS.values()):
        cells = ", ".join(f"{a}-{b}" for (a, b), pair in PAIRS.items() if pair.method == method)
        lines.append(f"| {method} | {cells} |")
    lines += [
        "",
        "Every pair is differentiable in poses and sizes (away from changes of the closest features). Closed forms and",
        "separating axes are exact to round-off; the iterative pairs are polished to it and raise a flag if they are not.",
    ]
    lines += ["", "A compound is several of these on one body. Planes and heightfields never move, so they never meet."]
    present = [feature for feature in FEATURES if exists(feature)]
    lines += ["", "| works | tested in |", "|---|---|"]
    lines += [f"| {feature.name} | `tests/{feature.test}` |" for feature in present if tested(feature)]
    untested = [feature.name for feature in present if not tested(feature)]
    if untested:
        lines += ["", f"Written, but without a test: {'; '.join(untested)}."]
    absent = [feature.name for feature in FEATURES if feature not in present]
    if absent:
        lines += ["", f"Not yet here: {'; '.join(absent)}."]
    return "\n".join(lines) + "\n"


def _pair(first: str, second: str) -> str:
    pair = PAIRS.get((first, second)) or PAIRS.get((second, first))
    if pair is not None:
        return str(pair.point_count)
    return "-" if SHAPES[first].static_only and SHAPES[second].static_only else "not yet"


def exists(feature: Feature) -> bool:
    """Whether the code of a feature is there."""
    module_name, attribute = feature.source.split(":")
    module = _import(module_name)
    return module is not None and (hasattr(module, attribute) or _import(f"{module_name}.{attribute}") is not None)


def _import(name: str) -> ModuleType | None:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name:
            raise
        return None


def tested(feature: Feature) -> bool:
    """Whether the test of a feature is there."""
    path = ROOT / "tests" / feature.test
    return any(path.glob("test_*.py")) if path.is_dir() else path.exists()


def measured() -> str:
    """Headline figures of the last report with their settings."""
    if not REPORT.exists():
        return "Not measured yet: `make bench`.\n"
    report = json.loads(REPORT.read_text())
    machine = report["machine"]
    kind = "quick run, too short for publication" if report["settings"]["mode"] == "quick" else "full run"
    lines = [
        f"{machine['processor']}, {machine['cores']} cores, {report['date']}, {kind}; medians, per CPU-second of all "
        "threads, peers interleaved in the same run. All figures: "
        "[`tests/benchmarks/results/report.md`](tests/benchmarks/results/report.md).",
        "",
        "| figure | measured | target | settings |",
        "|---|---|---|---|",
    ]
    lines += [_line(figure) for figure in figures(report) if any(part in figure.name for part in HEADLINES)]
    return "\n".join(lines) + "\n"


def _line(figure: Figure) -> str:
    verdict = {True: "met", False: "**missed**", None: ""}[figure.met]
    target = f"{figure.target}: {verdict}" if figure.target else verdict
    return f"| {figure.name} | {figure.value} | {target} | {figure.settings} |"


if __name__ == "__main__":
    sys.exit(main())
