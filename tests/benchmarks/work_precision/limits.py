"""What limits the scenes whose targets are not met, and what was tried. Shown in the report beside the missing factor."""

LIMITS = {
    "stack10": "the machine on the day: it gave MuJoCo 0.74 of its rate of 23 November, when 111 k/s were measured here; "
    "the ratio to MuJoCo is the same. A step is some 2700 kernels of 50 ns to launch (9 %), and 128 worlds pass 7 MB "
    "through a cache of 1 MB: 96 worlds are 5 % faster, 32 a quarter slower. What is stored without a division, and "
    "products taken constraint by constraint, gained 18 % since",
    "massratio": "in part the machine on the day: it gave MuJoCo 0.6 of its rate of 23 November, when 548 k/s were measured "
    "here; the ratio to MuJoCo, tuned, is 2.35 instead of 3.0",
    "hulls8": "the machine on the day: the engine of 23 November, for which 45 k/s were measured then, gave 27.6 k/s beside "
    "this one (1.16 times as fast, interleaved, 128 worlds). Eight or nine pairs of 28 are close, three overlap. In 128 "
    "worlds search and clipping are 65 % of a step, in some 1600 kernels of one to four microseconds: 15 iterations of GJK "
    "of some 40 kernels each, the exact axes (12 %), faces and their clipping (15 %). Sweeps over them one after the other "
    "take 6 %. Reductions over 3 to 12 rows without the library that XLA hands them to gained 6 %, room for nine pairs "
    "instead of 16 another fifth. After this measurement tables of what overlaps, whose worlds lie side by side, made a "
    "step 1.24 times as fast (interleaved); on the slower machine of 29 November that is 29.8 k/s, 1.47 times MuJoCo's "
    "default there. Worlds that differ, as these do not, fill more chunks of the list of pairs: up to a third slower",
}
