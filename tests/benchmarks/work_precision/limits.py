"""What limits the scenes whose targets are not met, and what was tried. Shown in the report beside the missing factor."""

LIMITS = {
    "tumble": "round-off of float32: the motion passes close by its unstable axis. In float64 the same program errs by "
    "1e-4 deg at 1/240 s. All settings share one integrator, so none of them helps",
    "stack10": "nine turns of a sweep follow one another: 54 turns a step of 12 kernels each, a microsecond apiece at 128 "
    "worlds, are a third of it; the rest is 550 kernels that run once, for 45 pairs that are tested and 9 that touch (tight "
    "capacity leaves room for 16)",
    "massratio": "sweeps do not converge (about 4.6 for each unit of the mass ratio), so the scene needs `converged`, whose "
    "Newton iterations are paid for (1.4 a step at rest: round-off of the load shakes the light cube); it is 1000 times "
    "more exact than asked. Of 2.7 us a world-step about 1 us is LAPACK's elimination of 12 rows, the rest some 500 kernels "
    "of a microsecond and less. Elimination side by side for all worlds was tried: as fast for 12 rows, a third for 24",
    "pile27 boxes": "in 32 worlds (5.4 ms a step) a third are the 190 turns of ten sweeps over 19 close pairs, one after "
    "the other; much of the rest are the rows of 540 points at which 27 boxes could touch five planes: pairs with planes "
    "have slots of their own and never pass the broadphase",
    "hulls8": "polyhedra never pass the broadphase, since their faces are static: all 28 pairs are searched, clipped and "
    "solved, though five touch. In 64 worlds search and clipping are some 40 % of a step, exact separating axes of the "
    "pairs that touch (30 times 30 pairs of edges each) 20 %, sweeps 15 %, in 3500 kernels of a microsecond or two",
}
