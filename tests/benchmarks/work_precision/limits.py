"""What limits the scenes whose targets are not met, and what was tried. Shown in the report beside the missing factor."""

LIMITS = {
    "tumble": "round-off of float32: the motion passes close by its unstable axis. In float64 the same program errs by "
    "1e-4 deg at 1/240 s. All settings share one integrator, so none of them helps",
    "stack10": "nine turns of a sweep follow one another: 90 turns a step of 12 kernels each, a microsecond apiece at 128 "
    "worlds, are half of it; the other half is 550 kernels that run once, for 45 pairs that are tested and 9 that touch "
    "(tight capacity leaves room for 16). The figures of `pgs` are from before its "
    "contacts over-relaxed; fewer sweeps may do since then",
    "massratio": "sweeps do not converge (about 4.6 for each unit of the mass ratio), so the scene needs `converged`, whose "
    "Newton iterations are paid for; it is 1000 times more exact than asked",
}
