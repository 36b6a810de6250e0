"""Smoothing: the whole path and map, estimated from all measurements of a run.

Read in this order:
- `genealogy`: the tree of particles and their ancestors; the smoothed path that it holds.
- `refine`: least squares over one lineage, alternating with reassociation; start here for the map.
- `least_squares`, `residuals`, `normal_equations`: the robust solver, its model, linear algebra.
- `reassociation`: merge, drop and triangulate landmarks, and choose associations again.
- `rejuvenation`, `posterior_sampling`: redraw the filter's particles from the refined posterior.
- `events`: what rejuvenation did to the map.

NumPy in float64 on the host; JAX for derivatives and for drawing particles.
"""
