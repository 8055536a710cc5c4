"""What limits the scenes whose targets are not met, and what was tried. Shown in the report beside the missing factor."""

LIMITS = {
    "tumble": "round-off of float32: the motion passes close by its unstable axis. In float64 the same program errs by "
    "1e-4 deg at 1/240 s. All settings share one integrator, so none of them helps",
    "stack10": "45 pairs of boxes are tested and hold 180 slots where 9 touch: room for 16 pairs makes a step 1.4 times as "
    "fast (tight capacity). `pgs` settles by its slop, 0.05 mm a contact; `converged` is exact enough but factorizes 60 "
    "rows an iteration",
    "massratio": "sweeps do not converge (about 4.6 for each unit of the mass ratio), so the scene needs `converged`, whose "
    "Newton iterations are paid for; it is 1000 times more exact than asked",
}
