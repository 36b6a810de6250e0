"""The models that the filter and the smoother share: motion and measurement, on JAX arrays.

Read `motion` first (the paper's section III-C), then `sensors` (III-B); `geometry` has the angles,
poses and 2 x 2 algebra of both. What the numbers are is in `jaxslam/parameters.py`.
"""
