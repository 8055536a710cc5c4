"""Fit friction, restitution, inertia and centre of mass to half of the tosses of a real cube and predict the others.

``python -m training.cube_toss --data cube_toss.npz`` prints a table and writes it with ``--output FILE.md``.

The data are tosses of an acrylic cube onto a table by S. Pfrommer, M. Halm and M. Posa, "ContactNets: Learning
Discontinuous Contact Dynamics with Smooth, Implicit Representations", CoRL 2020 (``data/tosses_processed`` of
github.com/DAIRLab/contact-nets, BSD 3-Clause), converted to one NPZ file in SI units with z up and the table at z = 0:

    length (toss,) valid frames; position (toss, frame, 3) [m]; orientation (toss, frame, 4) unit quaternions (w, x, y, z),
    body to world; velocity and angular_velocity (toss, frame, 3), world frame, the velocity being that half a frame
    earlier; dt, mass, half_width ().

Tosses with even index are fitted, those with odd index predicted, and then the other way round. Errors are means over the
frames of a toss, then over tosses: distance of the centres as a share of the width of the block, and angle between the
orientations. Everything that is fitted is physics of the cube, and is fitted by gradient (see `training.cube_toss_fit`).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from training.cube_toss_data import Tosses, load_tosses
from training.cube_toss_fit import Estimate, fit_tosses
from training.cube_toss_model import SETTINGS, errors

PEERS = {
    "recorded first frame": {"MuJoCo": (12.9, 17.4), "Bullet": (13.4, 17.0), "Drake": (12.5, 17.7)},
    "start fitted to the free flight": {"MuJoCo": (10.7, 13.2), "Bullet": (11.0, 13.0), "Drake": (12.0, 13.8)},
}
"""Errors (% of the width, degree) of engines tuned to these tosses; with the inertia free in the second setting alone."""


def main(arguments: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        prog="python -m training.cube_toss", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True, help="the NPZ file")
    parser.add_argument("--output", type=Path, help="Markdown file for the table")
    parser.add_argument("--steps", type=int, default=12, help="most steps of the fit to whole motions (default 12)")
    options = parser.parse_args(arguments)
    try:
        tosses = load_tosses(options.data)
        text = report(tosses, options.steps)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(text)
    if options.output:
        options.output.write_text(text)
    return 0


def report(tosses: Tosses, steps: int) -> str:
    """Fits and predicts in both settings; a Markdown text."""
    halves = [np.arange(tosses.count) % 2 == parity for parity in (0, 1)]
    lines = [
        "# Tosses of a cube",
        "",
        f"{tosses.count} tosses. Written by `python -m training.cube_toss`, which says where the data come from and how",
        "errors are counted. Each half is predicted with parameters fitted to the other one; medians in brackets.",
        "",
        "| start | fitted to | predicted | position [% of width] | rotation [degree] | parameters |",
        "|---|---|---|---|---|---|",
    ]
    estimates = [fit_tosses(tosses.take(half), SETTINGS, steps) for half in halves]
    for number, setting in enumerate(SETTINGS):
        found = []
        for parity, name, other in ((0, "even", "odd"), (1, "odd", "even")):
            estimate = estimates[parity][number]
            found.append(errors(tosses.take(halves[1 - parity]), setting, estimate.parameters))
            lines.append(f"| {setting} | {name} | {other} | {_figures(*found[-1])} | {_describe(estimate)} |")
        position, rotation = (np.concatenate(part) for part in zip(*found, strict=True))
        lines.append(f"| {setting} | other half | all | {_figures(position, rotation)} | |")
        for peer, (peer_position, peer_rotation) in PEERS[setting].items():
            lines.append(f"| {setting} | | {peer}, tuned | {peer_position} | {peer_rotation} | |")
    return "\n".join(lines) + "\n"


def _figures(position: np.ndarray, rotation: np.ndarray) -> str:
    return f"{position.mean():.2f} ({np.median(position):.2f}) | {rotation.mean():.2f} ({np.median(rotation):.2f})"


def _describe(estimate: Estimate) -> str:
    known = estimate.parameters
    low, high = estimate.friction_interval
    inertia = ", ".join(f"{1e3 * value:.2f}" for value in known.inertia)
    centre = ", ".join(f"{1e3 * value:.1f}" for value in known.centre_of_mass)
    return (
        f"friction {known.friction:.3f} (first impacts {estimate.first_friction:.3f}, {low:.3f} to {high:.3f}), restitution "
        f"{known.restitution:.3f}, inertia ({inertia}) g m², corner radius {known.corner_radius * 1e3:.1f} mm, centre of "
        f"mass ({centre}) mm off the middle, half width {known.half_width * 1e3:.2f} mm, gravity {known.gravity:.2f} m/s²"
    )


if __name__ == "__main__":
    sys.exit(main())
