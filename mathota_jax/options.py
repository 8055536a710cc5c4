"""Every tunable of the engine with its default, unit and place in the guide."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from mathota_jax import measured

BROADPHASE_CHOICES = ("auto", "none", "all_pairs", "sort_and_sweep", "grid", "bvh")

SOLVER_CHOICES = ("pgs", "converged", "soft_step")

DEFAULT_SUBSTEPS = 4

OPTIONAL = (("gradient_iterations", 1), ("pair_capacity", 1), ("substeps", 1), ("touching_capacity", 1))
"""Integers that may be None, and their least value."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Settings of a simulation. All but `dt` are static: changing one compiles another program.

    A damping, correction or warm start that is switched off (0 or False) is absent from the program, not multiplied by
    zero.

    Attributes:
      dt: time step [s]. Becomes the traced leaf `Model.dt`, so that it may change between steps. Guide 11.3.
      velocity_iterations: sweeps of the projected Gauss-Seidel solver. Guide 9.2.
      position_iterations: sweeps of the position correction, 0 for none. Guide 10.2.
      linear_damping: rate at which linear velocity decays [1/s]. Guide 4.2.
      angular_damping: rate at which angular momentum decays [1/s]. Guide 4.2.
      slop: penetration that is left alone, as a fraction of the smaller body's inner radius. Guide 10.2 says 0.005; ten
        boxes then settle by 1.6 mm, with the default by 0.1 mm, and rest just as quietly.
      position_percent: share of the position error corrected in a step. Guide 10.3.
      baumgarte: share of a joint's position error turned into velocity in a step, where `position_iterations` is 0 and so
        nothing else closes joints. It adds energy, and without bound where joints contradict each other. Guide 9.5.
      warm_start: start the solver from the impulses of the previous step. Guide 7.3 and 12.4.
      warm_start_match: distance up to which a contact of a pair whose feature is gone passes its impulse to a new one, in
        inner radii of the smaller moving body, from whose centre places are measured; 0 for none. For round rims and
        heightfields, where features change although a contact stays; absent in scenes without. Guide 7.3 and 11.3.
      broadphase: "auto": in scenes of up to 20 possible pairs, and for heightfields and planes, each pair has its own
        contact slots; the others are found in every step by the method that suits the size of the scene, and so are pairs
        with planes where shapes would have many points on them (boxes in a bin). "none": every pair has its own slots.
        Or the method: "all_pairs", "sort_and_sweep", "grid", "bvh". Guide 5.4.
      pair_capacity: pairs that the broadphase can find in one step; None for all of up to 300 possible ones, else 8 for
        each moving shape and at least 100. Empty places cost memory traffic: 27 boxes in a bin, of whose pairs 30 are
        close, take 1.4 times as long with this room (216) as with room for 40.
      touching_capacity: pairs that can touch at the same time where contacts are solved with the joints held (see
        `exact_joints`), beside those that always have rows; pairs with the most points, or more with fewer. None for one
        for each moving shape of a link, four for each other one, and at least 8. They take places in a dense matrix: what
        touches beyond them passes through (`Flag.CONTACT_OVERFLOW`). Where the matrix has too little room, fewer may be
        asked for.
      gradient_iterations: sweeps of the linear solver behind a derivative. None for the solution, by one dense system, in
        scenes of up to ten moving bodies, and in what mechanisms solve with their joints held; elsewhere for 1.5 times the
        solver's own sweeps where all rows are contacts with friction, for which they are accelerated, and for twice as many
        where not.
      solver: "pgs": a fixed number of sweeps, the cheapest and what most scenes need. "converged": all constraints
        solved together by Newton's method, for tall stacks, large mass ratios and exact derivatives; a world that it
        can not solve is flagged (`Flag.SOLVER_NOT_CONVERGED`). Each iteration factorizes a matrix of 6 rows a moving
        body; warm started rest takes 0 to 5 of them, a falling pile 20. Ten stacked boxes: 0.7 CPU-ms a step in float32
        and 6e-6 m of movement, but 26 CPU-s to compile. Of the numbers of iterations above only
        `position_iterations=0`, which leaves positions alone, means anything to it. "soft_step": one collision pass and
        several substeps of four sweeps each, which also take out position errors and are differentiated as they are: for
        stacks, piles and what falls on small bodies. Cubes of 1 m at 60 Hz: a stack of 10 dips by 3 mm, with "pgs" by 15;
        one of 20 by 14 mm, with "pgs" by 0.3 m. A load sinks into what it rests on by ``load / (2 effective mass * (pi / 2
        * substep rate)^2)``: a cube of 100 times the mass into another by 3.5 % of its size, with 16 substeps by 0.2 %. What
        has no contacts and is one with its joints is solved as with "pgs"; beside contacts, stiff springs and servos of
        mechanisms are beyond it (`build` warns). `position_iterations`, `slop`, `position_percent`, `baumgarte` and
        `gradient_iterations` do not concern it, and `velocity_iterations` is the number of sweeps of its restitution
        pass. All figures: docs/solvers.md.
      conjugate: take the sweeps of "pgs" along conjugate directions where bodies lie on one another: for tall stacks and
        large mass ratios. At 60 Hz with ten sweeps in float32 a cube of 100 times the mass rests on a cube to 4e-6 of its
        size, of 1000 times the mass it dips by 4 % (sweeps alone let both fall through), and forty cubes stand, dipping by
        0.1 %. Ten such sweeps take a step 1.3 times as long. Worlds in which a contact slides are solved by sweeps alone;
        absent in scenes that bounce, and where joints are solved beside the contacts.
      exact_joints: joints that are connected, trees and closed loops, are solved together, exactly, and closed at the
        end of the step; with `impact_events` as by "converged". "pgs": contacts are solved with the joints held, so that a
        robot stands on feet of any mass, where 192 rows suffice for motors, friction, stops and contacts, of those of a
        broadphase or of many pairs for what touches at a time, and there are no other joints. Elsewhere three and more
        joints, or fewer where a scene has nothing else to solve, or has springs or servos among several rows that drive
        them. "soft_step" sweeps joints in its small steps beside contacts, and closes them at the end. With the other
        solvers other ones and twos, and with all of them nets whose loops more than 96 rows close, are left to the
        solver. Off: absent. Limits, motors, springs and friction on their joints are solved with all that hangs on
        them, by `velocity_iterations` sweeps of their own ("pgs"): on an arm whose end is a hundred times as heavy as
        its first link, a stop or a spring acts as it would on one rigid body. Springs and servos may be as stiff as
        they like.
        Without it an error travels one joint a sweep: ten links at 1/240 s part by 5e-3 of a link and twenty at 1/60 s gain
        energy without bound; with it no gap is left but round-off. A step of ten links with "pgs" takes 1.2 times as long.
      substeps: of "soft_step" alone; None for 4. The load that a contact sinks under falls with their square. Guide 12.3.
      continuous: check the motion of fast bodies for what they meet on their way and stop them at the first touch, to be
        handled in the next step. Off: absent; contacts found at the start of a step are then extrapolated over it, which
        is exact for bodies that hit what they head for, but lets fast turning ones slip through and stops others at what
        they would have passed. Guide 10.4.
      impact_events: impacts of one step at which it is split, 0 for none; absent where nothing bounces. The forces of the
        step act before and after each, all bodies are taken where they are at the time of the impact, and those that
        touch there collide in rounds, which passes the whole velocity through a cradle. What comes after the last event is
        an ordinary step, in which a pair can bounce once. Off, the first bounce of a step is exact too, in value and
        derivative, for a ball on a plane: its time is found in closed form, with the contact normal of the start of
        the step. Set it where bodies bounce off each other, off edges and corners or more often than once a step, or where
        their momenta, energy or derivatives must be exact: then they are, to round-off, at any time step. Followed are the
        pairs that have contact slots of their own: up to 300 with "auto". Where there are joints, all is solved as by
        "converged", whatever the solver: an impact goes through all of them at once, in which bounded forces (springs,
        friction, motors with a cap) do nothing. Not with "soft_step", `continuous` or `sleep`. A step without impact costs
        a look at its contacts more, one with k impacts k + 1 steps and k searches; a batch takes as many parts as the world
        with most impacts. Compiling takes 3 times as long, with derivatives 5 times.
      sleep: let islands of bodies at rest sleep until something disturbs them; off: absent. Guide 3.4 and 12.2. A body
        asleep does not move at all, and a step in which every body of every world sleeps costs next to nothing. Changed
        leaves of the model, such as gravity, wake no one: see `wake`.
      sleep_velocity: speed below which a body may be at rest [m/s]. Guide 11.3. It belongs to things about a metre long
        under the gravity of the Earth: in other scenes it should grow with the square root of length times gravity.
      sleep_angular_velocity: angular speed below which a body may be at rest [rad/s]; grows with the square root of
        gravity over length.
      sleep_time: how long all bodies of an island must be at rest before it sleeps [s]; grows with the square root of
        length over gravity.
    """

    dt: float = 1 / 60
    velocity_iterations: int = 10
    position_iterations: int = 3
    linear_damping: float = 0.01
    angular_damping: float = 0.05
    slop: float = 0.0001
    position_percent: float = 0.8
    baumgarte: float = 0.1
    warm_start: bool = True
    warm_start_match: float = 0.02
    broadphase: str = "auto"
    pair_capacity: int | None = None
    touching_capacity: int | None = None
    gradient_iterations: int | None = None
    solver: str = "pgs"
    conjugate: bool = False
    exact_joints: bool = True
    substeps: int | None = None
    continuous: bool = False
    impact_events: int = 0
    sleep: bool = False
    sleep_velocity: float = 0.05
    sleep_angular_velocity: float = 0.05
    sleep_time: float = 0.5

    def __post_init__(self) -> None:
        if not (_is_number(self.dt) and self.dt > 0):
            raise ValueError(f"Options.dt must be a positive finite number of seconds, got {self.dt!r}")
        for name, minimum in (
            ("velocity_iterations", 1),
            ("position_iterations", 0),
            ("impact_events", 0),
            *OPTIONAL,
        ):
            value = getattr(self, name)
            optional = (name, minimum) in OPTIONAL and value is None
            if not optional and not _is_integer(value, minimum):
                raise ValueError(f"Options.{name} must be an integer of at least {minimum}, got {value!r}")
        for name in ("linear_damping", "angular_damping", "slop", "warm_start_match"):
            value = getattr(self, name)
            if not (_is_number(value) and value >= 0):
                raise ValueError(f"Options.{name} must be a finite number of at least 0, got {value!r}")
        for name in ("position_percent", "baumgarte"):
            value = getattr(self, name)
            if not (_is_number(value) and 0 <= value <= 1):
                raise ValueError(f"Options.{name} must lie between 0 and 1, got {value!r}")
        for name in ("sleep_velocity", "sleep_angular_velocity", "sleep_time"):
            value = getattr(self, name)
            if not (_is_number(value) and value > 0):
                raise ValueError(f"Options.{name} must be a positive finite number, got {value!r}")
        for name in ("warm_start", "conjugate", "exact_joints", "continuous", "sleep"):
            value = getattr(self, name)
            if not isinstance(value, bool):
                raise ValueError(f"Options.{name} must be True or False, got {value!r}")
        if self.solver not in SOLVER_CHOICES:
            known = ", ".join(repr(choice) for choice in SOLVER_CHOICES)
            raise ValueError(f"Options.solver must be one of {known}, got {self.solver!r}")
        if self.conjugate and self.solver != "pgs":
            raise ValueError(f"Options.conjugate needs solver='pgs', of whose sweeps it is; got solver={self.solver!r}")
        if self.substeps is not None and self.solver != "soft_step":
            raise ValueError(
                f"Options.substeps = {self.substeps} needs solver='soft_step', got solver={self.solver!r}; "
                "for smaller steps of this solver divide dt instead"
            )
        if self.impact_events and self.solver == "soft_step":
            raise ValueError("Options.impact_events needs solver='pgs' or 'converged', got solver='soft_step'")
        if self.impact_events and (self.continuous or self.sleep):
            raise ValueError(
                f"Options.impact_events = {self.impact_events} can not be combined with continuous={self.continuous}, "
                f"sleep={self.sleep}; switch these off"
            )
        if self.broadphase not in BROADPHASE_CHOICES:
            known = ", ".join(repr(choice) for choice in BROADPHASE_CHOICES)
            raise ValueError(f"Options.broadphase must be one of {known}, got {self.broadphase!r}")

    @classmethod
    def for_error(cls, error: float, kind: str = "any", **changes: Any) -> Options:
        """The cheapest measured settings that keep an error, without damping.

        Solver, sweeps and time step come from a table (`mathota_jax/error_table.json`): those whose error was at most
        `error` in every benchmark scene of the kind, and among them the one that cost least. It is a promise for scenes
        like those, within a factor of two; tests/benchmarks/results/work_precision.md shows them. A frame of fixed length
        takes ``round(frame / options.dt)`` steps: `substep`, `advance`.

        Args:
          error: relative to the scale of a scene: distance, height or speed of one moving body, edge of stacked boxes,
            length of a chain, diameter of the bodies of a pile; between 0 and 1.
          kind: "single": one body that flies, tumbles, slides, rolls, bounces or sticks. "stack": ten equal boxes.
            "mass_ratio": 1000 kg on 1 kg. "chain": ten links. "pile": 27 bodies in a bin, hulls in a heap. "any": all but
            piles.
          **changes: other fields of `Options`.

        Raises:
          ValueError: an error or kind out of range, or no measured setting is so exact.
        """
        if not (_is_number(error) and 0 < error < 1):
            raise ValueError(f"Options.for_error: error must lie between 0 and 1, got {error!r}")
        if kind not in measured.kinds():
            known = ", ".join(repr(name) for name in measured.kinds())
            raise ValueError(f"Options.for_error: kind must be one of {known}, got {kind!r}")
        choice = measured.cheapest(error, kind)
        undamped = {"linear_damping": 0.0, "angular_damping": 0.0}
        return cls(**{"dt": choice.dt, **undamped, **choice.options, **changes})

    @property
    def substep_count(self) -> int:
        """Substeps of a step of the small-steps tier."""
        return DEFAULT_SUBSTEPS if self.substeps is None else self.substeps


def _is_number(value: Any) -> bool:
    return (
        isinstance(value, int | float | np.integer | np.floating)
        and not isinstance(value, bool)
        and math.isfinite(value)
    )


def _is_integer(value: Any, minimum: int) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and bool(value >= minimum)
