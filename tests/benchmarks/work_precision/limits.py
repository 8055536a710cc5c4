"""What limits the scenes whose targets are not met, and what was tried. Shown in the report beside the missing factor."""

LIMITS = {
    "tumble": "round-off of float32: the motion passes close by its unstable axis, which multiplies it by a thousand. So "
    "the exact setting runs in float64, where a step is 120 kernels of which 40 are divisions: those take four times as "
    "long as in float32 (four numbers at a time, twice as slowly)",
    "stack10": "nine turns of a sweep follow one another: 54 turns a step of 12 kernels each, a microsecond apiece at 128 "
    "worlds, are a third of it; the rest is 550 kernels that run once, for 45 pairs that are tested and 9 that touch (tight "
    "capacity leaves room for 16)",
    "massratio": "sweeps do not converge (about 4.6 for each unit of the mass ratio), so the scene needs `converged`, whose "
    "Newton iterations are paid for (1.4 a step at rest: round-off of the load shakes the light cube); it is 1000 times "
    "more exact than asked. Of 2.7 us a world-step about 1 us is LAPACK's elimination of 12 rows, the rest some 500 kernels "
    "of a microsecond and less. Elimination side by side for all worlds was tried: as fast for 12 rows, a third for 24",
    "hulls8": "eight or nine pairs of 28 are close, three overlap. In 128 worlds search and clipping of two chunks of seven "
    "places are some 55 % of a step, sweeps over them one after the other 15 %, in some 6800 kernels of a microsecond or "
    "two. Chunks of 14 places gain nothing. Of 900 pairs of edges one is left to test for the axis of least overlap",
}
